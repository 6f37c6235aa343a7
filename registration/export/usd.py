"""USD: a head with quads, one subset and material per part, blend shapes, or time samples of a sequence.

Text layers (.usda, .usd) are written here, without a library. Crate files (.usdc) and packages (.usdz) are converted
from them by usd-core, which is optional.
"""

import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from jaxtyping import Float, Int

from registration.export.glb import ROUGHNESS
from registration.export.head_mesh import HeadMesh, unit_normals

MODULE = "pxr"  # of usd-core
_STILL = 1e-3  # changes of unit normals below this are left out
_JOINT = "root"  # USD binds blend shapes to a mesh only by way of a skeleton


def write_usda(mesh: HeadMesh, file: Path, texture: str | None) -> None:
    """Write a head as a text layer: metres, +Y up.

    Args:
        mesh: the head.
        file: the layer.
        texture: name of the texture's file beside it; None: no texture.
    """
    with file.open("w", encoding="utf-8") as stream:
        stream.writelines(_layer(mesh, texture))


def write_usdc(mesh: HeadMesh, file: Path, texture: str | None) -> None:
    """Write a head as a crate file, as `write_usda`. Needs usd-core."""
    from pxr import Sdf

    with TemporaryDirectory(dir=file.parent) as folder:
        text = Path(folder) / f"{file.stem}.usda"
        write_usda(mesh, text, texture)
        if not Sdf.Layer.FindOrOpen(str(text)).Export(str(file)):
            raise OSError(f"cannot write {file}")


def write_usdz(mesh: HeadMesh, file: Path, texture: str | None) -> None:
    """Write a head as a package of a crate file and its texture. Needs usd-core."""
    from pxr import Sdf

    from registration.export.glb import png_bytes

    with TemporaryDirectory(dir=file.parent) as folder:
        layer, image = Path(folder) / "head.usdc", Path(folder) / "head.png"
        write_usdc(mesh, layer, None if mesh.texture is None else image.name)
        package = Sdf.ZipFileWriter.CreateNew(str(file))
        package.AddFile(str(layer), layer.name)
        if mesh.texture is not None:
            image.write_bytes(png_bytes(mesh.texture))
            package.AddFile(str(image), image.name)
        if not package.Save():
            raise OSError(f"cannot write {file}")


def prim_names(names: list[str]) -> list[str]:
    """Return names that USD accepts, each once: letters, digits and underscores, no digit first."""
    chosen: list[str] = []
    for name in names:
        plain = re.sub(r"[^A-Za-z0-9_]", "_", name) or "_"
        plain = f"_{plain}" if plain[0].isdigit() else plain
        same = (plain, *(f"{plain}_{number}" for number in range(2, len(names) + 2)))
        chosen.append(next(candidate for candidate in same if candidate not in chosen))
    return chosen


def _layer(mesh: HeadMesh, texture: str | None) -> Iterator[str]:
    times = ""
    if mesh.frames is not None:
        rate = f"{mesh.frames_per_second:.9g}"
        times = f"    startTimeCode = 0\n    endTimeCode = {len(mesh.frames) - 1}\n"
        times += f"    timeCodesPerSecond = {rate}\n    framesPerSecond = {rate}\n"
    about = "".join(f"        string {name} = {_quoted(str(value))}\n" for name, value in mesh.origin.items())
    yield f'#usda 1.0\n(\n    defaultPrim = "head"\n    metersPerUnit = 1\n    upAxis = "Y"\n{times}'
    yield f'    customLayerData = {{\n        string creator = "gnm-registration"\n{about}    }}\n)\n\n'
    kind = "SkelRoot" if mesh.shapes else "Xform"
    yield f'def {kind} "head" (\n    displayName = {_quoted(mesh.name)}\n    kind = "component"\n)\n{{\n'
    yield from _mesh(mesh)
    if mesh.shapes:
        yield from _skeleton(list(mesh.shapes))
    yield from _materials(mesh.topology.materials, texture)
    yield "}\n"


def _mesh(mesh: HeadMesh) -> Iterator[str]:
    topology = mesh.topology
    schemas = '"MaterialBindingAPI"' + (', "SkelBindingAPI"' if mesh.shapes else "")
    yield f'    def Mesh "mesh" (\n        prepend apiSchemas = [{schemas}]\n    )\n    {{\n'
    yield f"        int[] faceVertexCounts = {_whole(np.full(len(topology.faces), topology.faces.shape[1]))}\n"
    yield f"        int[] faceVertexIndices = {_whole(topology.faces.reshape(-1))}\n"
    yield '        uniform token subdivisionScheme = "none"\n        uniform token orientation = "rightHanded"\n'
    if mesh.frames is None:
        yield f"        float3[] extent = {_extent(mesh.vertices)}\n"
        yield f"        point3f[] points = {_tuples(mesh.vertices)}\n"
        yield f"        normal3f[] normals = {_tuples(mesh.normals)} (\n"
    else:
        yield from _samples("float3[] extent", (_extent(frame) for frame in mesh.frames))
        yield from _samples("point3f[] points", (_tuples(frame) for frame in mesh.frames))
        normals = (unit_normals(frame, topology.triangles) for frame in mesh.frames)
        yield from _samples("normal3f[] normals", (_tuples(frame) for frame in normals))
        yield "        normal3f[] normals (\n"
    yield '            interpolation = "vertex"\n        )\n'
    uvs, index = np.unique(topology.face_uvs.reshape(-1, 2), axis=0, return_inverse=True)
    yield f'        texCoord2f[] primvars:st = {_tuples(uvs)} (\n            interpolation = "faceVarying"\n        )\n'
    yield f"        int[] primvars:st:indices = {_whole(index.reshape(-1))}\n"
    yield '        uniform token subsetFamily:materialBind:familyType = "partition"\n'
    if mesh.shapes:
        yield from _shapes(mesh)
    for number, name in enumerate(topology.materials):
        members = np.flatnonzero(topology.face_material == number)
        yield f'\n        def GeomSubset "{name}" (\n'
        yield '            prepend apiSchemas = ["MaterialBindingAPI"]\n        )\n        {\n'
        yield '            uniform token elementType = "face"\n'
        yield '            uniform token familyName = "materialBind"\n'
        yield f"            int[] indices = {_whole(members)}\n"
        yield f"            rel material:binding = </head/materials/{name}>\n        }}\n"
    yield "    }\n"


def _shapes(mesh: HeadMesh) -> Iterator[str]:
    names = prim_names(list(mesh.shapes))
    yield f"        uniform token[] skel:blendShapes = {_tokens(names)}\n"
    yield f"        rel skel:blendShapeTargets = [{', '.join(f'</head/mesh/{name}>' for name in names)}]\n"
    yield "        rel skel:skeleton = </head/skeleton>\n"
    for name, (title, shape) in zip(names, mesh.shapes.items(), strict=True):
        change = unit_normals(mesh.vertices + shape, mesh.topology.triangles) - mesh.normals
        rows = np.flatnonzero((np.abs(shape).max(1) > 0) | (np.abs(change).max(1) > _STILL))
        yield f'\n        def BlendShape "{name}" (\n'
        figures = "".join(
            f"                double {k} = {v:.6g}\n" for k, v in mesh.shape_figures.get(title, {}).items()
        )
        yield f"            customData = {{\n{figures}            }}\n" if figures else ""
        yield f"            displayName = {_quoted(title)}\n        )\n        {{\n"
        yield f"            uniform vector3f[] offsets = {_tuples(shape[rows])}\n"
        yield f"            uniform vector3f[] normalOffsets = {_tuples(change[rows])}\n"
        yield f"            uniform int[] pointIndices = {_whole(rows)}\n        }}\n"


def _skeleton(titles: list[str]) -> Iterator[str]:
    identity = "[( (1, 0, 0, 0), (0, 1, 0, 0), (0, 0, 1, 0), (0, 0, 0, 1) )]"
    yield '\n    def Skeleton "skeleton" (\n        prepend apiSchemas = ["SkelBindingAPI"]\n    )\n    {\n'
    yield f'        uniform token[] joints = ["{_JOINT}"]\n'
    yield f"        uniform matrix4d[] bindTransforms = {identity}\n"
    yield f"        uniform matrix4d[] restTransforms = {identity}\n"
    yield "        rel skel:animationSource = </head/animation>\n    }\n"
    yield '\n    def SkelAnimation "animation"\n    {\n'
    yield f"        uniform token[] blendShapes = {_tokens(prim_names(titles))}\n"
    yield f"        float[] blendShapeWeights = {_whole(np.zeros(len(titles), int))}\n    }}\n"


def _materials(names: tuple[str, ...], texture: str | None) -> Iterator[str]:
    yield '\n    def Scope "materials"\n    {\n'
    for name in names:
        path = f"/head/materials/{name}"
        yield f'        def Material "{name}"\n        {{\n'
        yield f"            token outputs:surface.connect = <{path}/surface.outputs:surface>\n\n"
        yield '            def Shader "surface"\n            {\n'
        yield '                uniform token info:id = "UsdPreviewSurface"\n'
        if texture is None:
            yield "                color3f inputs:diffuseColor = (0.5, 0.5, 0.5)\n"
        else:
            yield f"                color3f inputs:diffuseColor.connect = <{path}/texture.outputs:rgb>\n"
        yield f"                float inputs:roughness = {ROUGHNESS.get(name, 0.6)}\n"
        yield "                float inputs:metallic = 0\n                token outputs:surface\n            }\n"
        if texture is not None:
            yield from _texture(path, texture)
        yield "        }\n"
    yield "    }\n"


def _texture(path: str, texture: str) -> Iterator[str]:
    mark = "@@@" if "@" in texture else "@"
    yield '\n            def Shader "texture"\n            {\n'
    yield '                uniform token info:id = "UsdUVTexture"\n'
    yield f"                asset inputs:file = {mark}./{texture}{mark}\n"
    yield '                token inputs:sourceColorSpace = "sRGB"\n'
    yield '                token inputs:wrapS = "clamp"\n                token inputs:wrapT = "clamp"\n'
    yield f"                float2 inputs:st.connect = <{path}/uvs.outputs:result>\n"
    yield "                float3 outputs:rgb\n            }\n"
    yield '\n            def Shader "uvs"\n            {\n'
    yield '                uniform token info:id = "UsdPrimvarReader_float2"\n'
    yield '                string inputs:varname = "st"\n                float2 outputs:result\n            }\n'


def _samples(attribute: str, values: Iterator[str]) -> Iterator[str]:
    yield f"        {attribute}.timeSamples = {{\n"
    for number, value in enumerate(values):
        yield f"            {number}: {value},\n"
    yield "        }\n"


def _extent(points: Float[np.ndarray, "V 3"]) -> str:
    return _tuples(np.stack([points.min(0), points.max(0)]))


def _tuples(rows: Float[np.ndarray, "N D"]) -> str:
    """The text of an array of float32 tuples, from which the same numbers are read."""
    form = "(" + ", ".join(["%.9g"] * rows.shape[1]) + ")"
    return "[" + ", ".join([form] * len(rows)) % tuple(rows.astype(np.float32).reshape(-1).tolist()) + "]"


def _whole(numbers: Int[np.ndarray, "N"]) -> str:
    return "[" + ", ".join(map(str, numbers.tolist())) + "]"


def _tokens(names: list[str]) -> str:
    return "[" + ", ".join(f'"{name}"' for name in names) + "]"


_ESCAPES: Mapping[int, str] = {ord('"'): '\\"', ord("\\"): "\\\\", ord("\n"): "\\n", ord("\r"): "\\r", ord("\t"): "\\t"}


def _quoted(text: str) -> str:
    plain = "".join(c if c.isprintable() or c in "\n\r\t" else "?" for c in text)
    return f'"{plain.translate(_ESCAPES)}"'
