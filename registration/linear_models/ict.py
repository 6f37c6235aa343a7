"""ICT FaceKit: a folder of OBJ meshes, the neutral head and one for each identity and each expression.

Every mesh is the neutral one with one coefficient of 1. Identity coefficients are in standard deviations; expressions
are blendshapes, of weights from 0 to 1.
"""

import re
from functools import partial
from pathlib import Path

import numpy as np

from registration.errors import InputError
from registration.linear_models.data import LinearModelData, check, rigid
from registration.linear_models.frame import Frame, normalized
from registration.linear_models.options import ModelFormat, ReadOptions
from registration.storage.mesh_files import MeshFile
from registration.storage.obj import read_obj
from registration.storage.reading import open_file

TITLE = "ICT FaceKit"
LICENCE = "ICT FaceKit: the licence that the University of Southern California publishes it with (MIT)"
NEUTRAL = "generic_neutral_mesh.obj"
_IDENTITY = re.compile(r"identity(\d{3})\.obj")
_MAX_MESHES = 1024
_MAX_BYTES = 2**28  # of a mesh
_FIX = "use the folder FaceXModel of ICT FaceKit as published"


def read(path: Path, options: ReadOptions) -> LinearModelData:
    """Read the folder; other meshes in it than the neutral one and identities are expressions, by name.

    Raises:
        InputError: a mesh is damaged, has another number of vertices than the neutral one, or an identity is missing.
    """
    refuse = partial(InputError.unreadable, TITLE, where=path, fix=_FIX)
    files = sorted(file for file in path.iterdir() if file.suffix.lower() == ".obj" and file.name != NEUTRAL)
    if len(files) > _MAX_MESHES:
        raise refuse(expected=f"at most {_MAX_MESHES} meshes", got=len(files))
    identities = [file for file in files if _IDENTITY.fullmatch(file.name)]
    expressions = [file for file in files if file not in identities]
    for number, file in enumerate(identities):
        if int(file.name[8:11]) != number:
            raise refuse(expected=f"identity{number:03d}.obj", got=file.name)
    neutral = _mesh(path / NEUTRAL)
    template = neutral.vertices.astype(np.float64)

    def moved(meshes: list[Path]) -> np.ndarray:
        basis = np.zeros((len(meshes), *template.shape), np.float32)
        for k, file in enumerate(meshes):
            vertices = _mesh(file).vertices
            if vertices.shape != template.shape:
                raise InputError.unreadable(
                    TITLE, where=file, expected=f"{len(template)} vertices", got=len(vertices), fix=_FIX
                )
            basis[k] = vertices - template
        return basis

    identity, expression = moved(identities), moved(expressions)
    model = LinearModelData(
        name=TITLE,
        format="ict",
        licence=LICENCE,
        triangles=neutral.triangles.astype(np.int64),
        template=template.astype(np.float32),
        identity_basis=identity,
        expression_basis=expression,
        joints=rigid(template.astype(np.float32), identity, expression),
        remarks=("expressions are blendshapes of weights from 0 to 1, not standard deviations",),
    )
    check(model, path)
    return normalized(model, path, Frame(usual_m=1e-2), options)


def _mesh(file: Path) -> MeshFile:
    refuse = partial(InputError.unreadable, TITLE, where=file, fix=_FIX)
    open_file(file, refuse, max_bytes=_MAX_BYTES).close()
    try:
        mesh = read_obj(file)
    except (ValueError, OSError) as error:
        raise refuse(expected="an OBJ mesh", got=error) from None
    if not np.isfinite(mesh.vertices).all():
        raise refuse(expected="finite vertices", got="others")
    return mesh


def _detect(path: Path) -> bool:
    return path.is_dir() and (path / NEUTRAL).is_file()


FORMAT = ModelFormat(name="ict", title="ICT FaceKit (folder of OBJ)", detect=_detect, read=read)
