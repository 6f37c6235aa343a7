"""Landmark schemes of a model: named lists of points on its surface, each the weighted mean of three vertices."""

from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import overload

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from registration.errors import InputError
from registration.model import jaw_order
from registration.storage.reading import read_text

_PREFIX = "head_sparse_"
_FIX = "write one landmark a row as `i0 w0 i1 w1 i2 w2`: vertex indices from 0, weights that sum to 1"


@dataclass(frozen=True, kw_only=True, eq=False)
class LandmarkScheme:
    """L points on the surface, in the order of the scheme's file; captures must have the same order.

    The scheme of 68 points is in the corrected order (`registration.model.jaw_order`), whatever its file's is.
    """

    name: str  # "68" for head_sparse_68.txt
    indices: Int[np.ndarray, "L 3"]
    weights: Float[np.ndarray, "L 3"]  # rows sum to 1
    spread_m: Float[np.ndarray, "L"] | None = None  # standard deviation of a detector's point around it; None: unknown
    reversed_in_file: bool = field(default=False, metadata={"not_hashed": "the points are in the corrected order"})

    @overload
    def points(self, vertices: Float[np.ndarray, "*B V 3"]) -> Float[np.ndarray, "*B L 3"]: ...
    @overload
    def points(self, vertices: Float[Tensor, "*B V 3"]) -> Float[Tensor, "*B L 3"]: ...
    def points(self, vertices: np.ndarray | Tensor) -> np.ndarray | Tensor:
        """Return the landmarks on vertices, in the vertices' units and frame; of NumPy arrays or torch tensors."""
        if isinstance(vertices, Tensor):
            indices = torch.as_tensor(self.indices, device=vertices.device)
            return (vertices[..., indices, :] * vertices.new_tensor(self.weights)[..., None]).sum(-2)
        return (vertices[..., self.indices, :] * self.weights.astype(vertices.dtype)[..., None]).sum(-2)


def read_scheme(path: Path, template: Float[np.ndarray, "V 3"], name: str | None = None) -> LandmarkScheme:
    """Read a scheme from a text file of rows `i0 w0 i1 w1 i2 w2`.

    Args:
        path: the file.
        template: the model's template vertices, metres; tell the order of the rows of scheme 68.
        name: of the scheme; None: NAME of the file `head_sparse_NAME.txt`.

    Raises:
        InputError: the file has other rows, a vertex index is out of range, or weights do not sum to one.
    """
    path, vertex_count = Path(path), len(template)
    text = read_text(path, partial(InputError, "The landmark scheme cannot be read", where=path, fix=_FIX))
    try:
        rows = [[float(word) for word in line.split()] for line in text.splitlines() if line.strip()]
    except ValueError as error:
        raise _input_error("cannot be read", path, "rows of six numbers", error) from None
    for number, row in enumerate(rows):
        if len(row) != 6 or not np.isfinite(row).all():
            raise _input_error("has a wrong row", path, "six finite numbers", f"{row} in row {number}")
    if not rows:
        raise _input_error("is empty", path, "at least one row", "none")
    table = np.array(rows)
    indices, weights = table[:, ::2], table[:, 1::2]
    bad = np.flatnonzero(((indices < 0) | (indices >= vertex_count) | (indices != np.round(indices))).any(1))
    if len(bad):
        got = f"{indices[bad[0]].tolist()} in row {bad[0]}"
        raise _input_error("has a wrong vertex index", path, f"indices of the model's {vertex_count} vertices", got)
    bad = np.flatnonzero(np.abs(weights.sum(1) - 1) > 0.01)
    if len(bad):
        got = f"{weights[bad[0]]} in row {bad[0]}"
        raise _input_error("has wrong weights", path, "three weights that sum to 1", got)
    weights = weights / weights.sum(1, keepdims=True)  # the files round to three digits
    name = name or path.stem.removeprefix(_PREFIX)
    indices = indices.astype(np.int64)
    scheme = LandmarkScheme(name=name, indices=indices, weights=weights)
    if name != jaw_order.SCHEME or not jaw_order.is_reversed(scheme.points(template.astype(np.float64))):
        return scheme
    order = jaw_order.TURNED
    return replace(scheme, indices=indices[order], weights=weights[order], reversed_in_file=True)


def schemes_beside(model_path: Path, template: Float[np.ndarray, "V 3"]) -> dict[str, LandmarkScheme]:
    """Read all schemes `head_sparse_NAME.txt` in the model file's folder, by name. Raises InputError."""
    files = sorted(Path(model_path).parent.glob(f"{_PREFIX}*.txt"))
    return {scheme.name: scheme for scheme in (read_scheme(file, template) for file in files)}


def write_scheme(scheme: LandmarkScheme, model_path: Path) -> Path:
    """Write a scheme as `head_sparse_NAME.txt` into a model file's folder. Returns its path."""
    rows = zip(scheme.indices.tolist(), scheme.weights.tolist(), strict=True)
    lines = [" ".join(f"{i} {w:.9g}" for i, w in zip(index, weight, strict=True)) for index, weight in rows]
    path = Path(model_path).with_name(f"{_PREFIX}{scheme.name}.txt")
    path.write_text("\n".join(lines) + "\n", "ascii")
    return path


def _input_error(what: str, path: Path, expected: object, got: object) -> InputError:
    return InputError(f"The landmark scheme {what}", where=path, expected=expected, got=got, fix=_FIX)
