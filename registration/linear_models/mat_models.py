"""Models in MATLAB's files: LSFM, the Basel Face Model of 2009, and others with the same arrays.

Both versions of the format are read: 5, and 7.3, which is HDF5. LSFM has variances, the Basel model deviations.
"""

from collections.abc import Mapping
from functools import partial
from pathlib import Path

import numpy as np

from registration.errors import InputError
from registration.linear_models.data import LinearModelData, check, rigid
from registration.linear_models.frame import Frame, normalized
from registration.linear_models.npz_names import MATLAB_7_3, first_bytes
from registration.linear_models.options import ModelFormat, ReadOptions
from registration.linear_models.principal import scaled_basis, triangles_from_0, vertex_rows
from registration.storage.hdf5_files import open_hdf5
from registration.storage.mat_files import is_mat, read_mat

TITLE = "model in a MAT file"
LICENCE = (
    "LSFM or Basel Face Model: the terms of its publisher under which its user obtained the file; this program neither "
    "grants nor checks them"
)
MAX_BYTES = 2**31
_FIX = "use the model's file as published, or write its arrays as a plain NPZ (docs/other_models.md)"
MEANS = ("mean", "mu", "shapeMU")
BASES = ("components", "eigenvectors", "U", "shapePC")
VARIANCES = ("eigenvalues", "variances")
DEVIATIONS = ("shapeEV", "deviations")
TRIANGLES = ("trilist", "tri", "tl", "cells")
_NAMES = (*MEANS, *BASES, *VARIANCES, *DEVIATIONS, *TRIANGLES)


def read(path: Path, options: ReadOptions) -> LinearModelData:
    """Read a model of identities in a MAT file; it has no expressions and no joints.

    Raises:
        InputError: it is damaged, an array is missing, or they do not belong together.
    """
    refuse = partial(InputError.unreadable, TITLE, where=path, fix=_FIX)
    arrays = _from_hdf5(path, refuse) if first_bytes(path).startswith(MATLAB_7_3) else read_mat(path, refuse, _NAMES)

    def first(names: tuple[str, ...]) -> np.ndarray | None:
        return next((arrays[name] for name in names if name in arrays), None)

    mean, basis, triangles = first(MEANS), first(BASES), first(TRIANGLES)
    variances, deviations = first(VARIANCES), first(DEVIATIONS)
    for what, array in (("mean", mean), ("components", basis), ("triangles", triangles)):
        if array is None:
            expected = f"arrays of the names {' or '.join(MEANS)}, {' or '.join(BASES)}, {' or '.join(TRIANGLES)}"
            raise refuse(expected=expected, got=f"no {what}, but {', '.join(arrays) or 'nothing of these'}")
    assert mean is not None and basis is not None and triangles is not None
    if deviations is None:
        if variances is None:
            raise refuse(expected=f"one of {', '.join((*VARIANCES, *DEVIATIONS))}", got=", ".join(arrays))
        if not (variances >= 0).all():
            raise refuse(expected="variances from 0", got=f"{variances.min():g}")
        deviations = np.sqrt(variances)
    template = vertex_rows(mean, path).astype(np.float32)
    if not (np.isfinite(triangles).all() and (triangles == np.round(triangles)).all()):
        raise refuse(expected="triangles of whole numbers", got="others")
    if basis.ndim != 2:
        raise refuse(expected="a matrix of components", got=f"the shape {basis.shape}")
    identity, remark = scaled_basis(basis, deviations.ravel().astype(np.float64), len(template), path)
    expression = np.zeros((0, *template.shape), np.float32)
    remarks = (*((remark,) if remark else ()), "the file has no expressions")
    model = LinearModelData(
        name="Basel Face Model 2009" if "shapeMU" in arrays else "LSFM",
        format="mat",
        licence=LICENCE,
        triangles=triangles_from_0(triangles.astype(np.int64), len(template), path),
        template=template,
        identity_basis=identity,
        expression_basis=expression,
        joints=rigid(template, identity, expression),
        remarks=remarks,
    )
    check(model, path)
    return normalized(model, path, Frame(), options)


def _from_hdf5(path: Path, refuse: partial[InputError]) -> Mapping[str, np.ndarray]:
    """The same arrays of version 7.3, whose axes run the other way round."""
    with open_hdf5(path, refuse, max_bytes=MAX_BYTES) as file:
        return {name: file.array(name, kinds="fiu").T for name in _NAMES if file.has(name)}


def _detect(path: Path) -> bool:
    start = first_bytes(path)
    return is_mat(start) or start.startswith(MATLAB_7_3)


FORMAT = ModelFormat(name="mat", title="LSFM and Basel Face Model 2009 (MAT)", detect=_detect, read=read)
