"""The Basel Face Model 2017 and 2019: HDF5, with means and components of unit length for shapes and expressions."""

from functools import partial
from pathlib import Path

import numpy as np

from registration.errors import InputError
from registration.linear_models.data import LinearModelData, check, rigid
from registration.linear_models.frame import Frame, normalized
from registration.linear_models.npz_names import first_bytes
from registration.linear_models.options import ModelFormat, ReadOptions
from registration.linear_models.principal import scaled_basis, triangles_from_0, vertex_rows
from registration.storage.hdf5_files import Hdf5, open_hdf5

TITLE = "Basel Face Model"
LICENCE = (
    "Basel Face Model: the terms of the University of Basel under which its user obtained the file; this program "
    "neither grants nor checks them"
)
MAX_BYTES = 2**31
_FIX = "use model2017-1_bfm_nomouth.h5, model2017-1_face12_nomouth.h5 or a file of 2019 as published"
_MARK = "shape/model/pcaBasis"


def read(path: Path, options: ReadOptions) -> LinearModelData:
    """Read a Basel Face Model of 2017 or 2019; it has no joints, so that `without_jaw` changes nothing.

    Raises:
        InputError: it is damaged, or its arrays do not belong together.
    """
    refuse = partial(InputError.unreadable, TITLE, where=path, fix=_FIX)
    with open_hdf5(path, refuse, max_bytes=MAX_BYTES) as file:
        template = vertex_rows(file.array("shape/model/mean"), path)
        cells = file.array("shape/representer/cells", kinds="iu")
        identity, remark = _basis(file, "shape", len(template), path)
        remarks = [remark]
        expression = np.zeros((0, len(template), 3), np.float32)
        if file.has("expression/model/mean"):
            template = template + vertex_rows(file.array("expression/model/mean"), path)
            expression, remark = _basis(file, "expression", len(template), path)
            remarks.append(remark)
        else:
            remarks.append("the file has no expressions")
    template = template.astype(np.float32)
    model = LinearModelData(
        name=TITLE,
        format="basel",
        licence=LICENCE,
        triangles=triangles_from_0(cells, len(template), path),
        template=template,
        identity_basis=identity,
        expression_basis=expression,
        joints=rigid(template, identity, expression),
        remarks=tuple(remark for remark in remarks if remark),
    )
    check(model, path)
    return normalized(model, path, Frame(usual_m=1e-3), options)


def _basis(file: Hdf5, part: str, vertices: int, path: Path) -> tuple[np.ndarray, str | None]:
    variances = file.array(f"{part}/model/pcaVariance").ravel().astype(np.float64)
    deviations = np.sqrt(np.maximum(variances, 0)) if (variances >= 0).all() else variances
    basis, remark = scaled_basis(file.array(f"{part}/model/pcaBasis"), deviations, vertices, path)
    return basis, None if remark is None else f"{part}: {remark}"


def _detect(path: Path) -> bool:
    if not first_bytes(path).startswith(b"\x89HDF"):
        return False
    refuse = partial(InputError.unreadable, "linear model", where=path, fix=_FIX)
    with open_hdf5(path, refuse, max_bytes=MAX_BYTES) as file:
        return file.has(_MARK)


FORMAT = ModelFormat(name="basel", title="Basel Face Model 2017 (HDF5)", detect=_detect, read=read)
