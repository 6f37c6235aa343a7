"""Read GLB and glTF 2.0 files: the triangles of the whole scene in one mesh, with textures or vertex colours.

What a file declares is checked before trimesh builds arrays of it: counts, and files that it names beside itself.
"""

import io
import json
import struct
import urllib.parse
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8

from registration.errors import InputError
from registration.storage.mesh_files import MAX_ELEMENTS, MAX_FILE_BYTES, MeshFile
from registration.storage.reading import MAX_TEXT_BYTES, parse_json

_MAGIC, _JSON_CHUNK = b"glTF", 0x4E4F534A
_READ_EXTENSIONS = frozenset(
    "KHR_materials_unlit KHR_materials_pbrSpecularGlossiness KHR_mesh_quantization KHR_texture_transform".split()
)
_TRIANGLES = (4, 5, 6)  # modes of primitives: lists, strips, fans


def read_gltf(path: Path) -> MeshFile:
    """Read all triangles of a file, placed as its scene says.

    Raises:
        ValueError: it is damaged, too large, names files outside its folder, or needs an extension that is not read.
        OSError: the file cannot be read.
    """
    import trimesh

    content = path.read_bytes()
    binary = content[:4] == _MAGIC
    header = _header(_json_chunk(content) if binary else content)
    files = _check(header, path.parent)
    try:
        scene = trimesh.load_scene(
            io.BytesIO(content),
            file_type="glb" if binary else "gltf",
            resolver={name: file.read_bytes() for name, file in files.items()},
            process=False,
        )
        parts = [part for part in scene.dump() if isinstance(part, trimesh.Trimesh) and len(part.faces)]
        modes = [p.get("mode", 4) for m in header.get("meshes", []) for p in m.get("primitives", [])]
        others = sum(mode not in _TRIANGLES for mode in modes)
        if parts:
            return _merged(parts, {"points and lines": others} if others else {})
    except MemoryError:
        raise
    except Exception as error:  # the parser raises nearly anything for a damaged file
        raise ValueError(f"a damaged glTF file: {type(error).__name__}: {error}") from None
    raise ValueError("a scene without triangles")


def _json_chunk(content: bytes) -> bytes:
    """The first chunk of a GLB file. Raises ValueError if the lengths do not fit the file."""
    if len(content) < 20:
        raise ValueError("a GLB file that is cut short")
    _, version, length, size, kind = struct.unpack_from("<4sIIII", content)
    if version != 2:
        raise ValueError(f"GLB version {version}; only version 2 is read")
    if length > len(content) or kind != _JSON_CHUNK or 20 + size > len(content):
        raise ValueError(f"a GLB file that is cut short: {len(content)} of {length} bytes")
    return content[20 : 20 + size]


def _header(data: bytes) -> dict[str, Any]:
    if len(data) > MAX_TEXT_BYTES:
        raise ValueError(f"a glTF header of {len(data)} bytes")

    def refuse(*, expected: object, got: object) -> InputError:
        return InputError("The glTF header is damaged", where="the file", expected=expected, got=got)

    try:
        header = parse_json(data.rstrip(b"\0 \n"), refuse)
    except InputError as error:
        raise ValueError(f"a damaged glTF header: {error.got}") from None
    if not isinstance(header, dict) or str(header.get("asset", {}).get("version", "")).split(".")[0] != "2":
        raise ValueError("no glTF file of version 2")
    return header


def _check(header: Mapping[str, Any], folder: Path) -> dict[str, Path]:
    """The files beside it that it names. Raises ValueError for what is not read."""
    if unknown := sorted(set(map(str, header.get("extensionsRequired", []))) - _READ_EXTENSIONS):
        raise ValueError(f"it needs {', '.join(unknown)[:200]}: export it without compression")
    total = 0
    for number, accessor in enumerate(_objects(header, "accessors")):
        count = accessor.get("count")
        if not isinstance(count, int) or not 0 <= count <= MAX_ELEMENTS:
            raise ValueError(f"accessor {number} has the count {json.dumps(count)[:40]}")
        total += count if "bufferView" not in accessor else 0
    if total > MAX_ELEMENTS:
        raise ValueError(f"accessors of {total} values without data")
    files = {}
    for item in (*_objects(header, "buffers"), *_objects(header, "images")):
        uri = item.get("uri")
        if isinstance(uri, str) and not uri.startswith("data:"):
            file = (folder / urllib.parse.unquote(uri)).resolve()
            if urllib.parse.urlparse(uri).scheme or not file.is_relative_to(folder.resolve()) or not file.is_file():
                raise ValueError(f"it names {uri[:80]!r}, which is no file in its folder")
            if file.stat().st_size > MAX_FILE_BYTES:
                raise ValueError(f"{uri[:80]} has more than {MAX_FILE_BYTES} bytes")
            files[uri] = files[urllib.parse.unquote(uri)] = file
    return files


def _objects(header: Mapping[str, Any], name: str) -> list[dict[str, Any]]:
    items = header.get(name, [])
    if not isinstance(items, list) or not all(isinstance(item, dict) for item in items):
        raise ValueError(f"{name} of the glTF header are no list of objects")
    return items


def _merged(parts: list[Any], unread: Mapping[str, int]) -> MeshFile:
    """One mesh of several trimesh meshes."""
    first = np.cumsum([0, *(len(part.vertices) for part in parts)])
    triangles = [np.asarray(part.faces, np.int64) + start for part, start in zip(parts, first, strict=False)]
    textures: list[UInt8[np.ndarray, "H W 3"]] = []
    uvs, which, colours = [], [], []
    for part in parts:
        image, uv = _texture(part)
        which.append(np.full(len(part.faces), -1 if image is None else len(textures)))
        textures += [] if image is None else [image]
        uvs.append(np.full((len(part.faces), 3, 2), np.nan) if uv is None else uv[part.faces])
        colours.append(_colours(part))
    coloured = any(colour is not None for colour in colours)
    filled = [
        np.full((len(part.vertices), 3), 0.5) if colour is None else colour
        for part, colour in zip(parts, colours, strict=True)
    ]
    has_uv = any(np.isfinite(uv).any() for uv in uvs)
    return MeshFile(
        vertices=np.concatenate([np.asarray(part.vertices, np.float64) for part in parts]),
        triangles=np.concatenate(triangles),
        colours=np.concatenate(filled) if coloured else None,
        corner_uvs=np.concatenate(uvs) if has_uv else None,
        face_textures=np.concatenate(which) if textures else None,
        textures=tuple(textures),
        unread=unread,
    )


def _texture(part: Any) -> tuple[UInt8[np.ndarray, "H W 3"] | None, Float[np.ndarray, "V 2"] | None]:
    """The colour image of a part and its uvs, of the vertices."""
    uv = getattr(part.visual, "uv", None)
    if uv is None:
        return None, None
    material = getattr(part.visual, "material", None)
    image = getattr(material, "baseColorTexture", None)
    if image is None:
        image = getattr(material, "image", None)
    return None if image is None else np.asarray(image.convert("RGB"), np.uint8), np.asarray(uv, np.float64)[:, :2]


def _colours(part: Any) -> Float[np.ndarray, "V 3"] | None:
    """The vertex colours of a part, in [0, 1]."""
    values = part.vertex_attributes.get("color")
    if values is None and part.visual.kind == "vertex":
        values = part.visual.vertex_colors
    if values is None or len(values) != len(part.vertices):
        return None
    values = np.asarray(values)
    top = np.iinfo(values.dtype).max if values.dtype.kind in "iu" else 1.0
    return np.clip(values[:, :3] / top, 0, 1).astype(np.float64)
