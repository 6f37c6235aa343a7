"""Landmark schemes of a model: named lists of points on its surface, each the weighted mean of three vertices.

A scheme's file has one landmark a row, `i0 w0 i1 w1 i2 w2`, with the spread in metres as an optional seventh number,
and comments: `# name: value` states an entry of the file's header, as in the shipped maps of detectors' points.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import overload

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from registration.errors import InputError
from registration.model import gnm_npz, jaw_order
from registration.storage.files import atomic_file
from registration.storage.reading import read_text

KIND, VERSION = "landmark map", 1  # entries `kind` and `version` of the header of a map that the project writes
SHIPPED = Path(__file__).with_name("landmark_maps")
_PREFIX = "head_sparse_"
_MAX_SPREAD_M = 1.0
_TOPOLOGY_DIGITS = 16  # of the topology's hash in the name of a shipped map
_FIX = (
    "write one landmark a row as `i0 w0 i1 w1 i2 w2`: vertex indices from 0, weights that sum to 1; "
    "then its spread in metres, in all rows or in none"
)


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
    header: Mapping[str, str] = field(
        default_factory=dict, metadata={"not_hashed": "says where the points come from, which decide"}
    )
    shipped: bool = field(default=False, metadata={"not_hashed": "the points decide, not where their file lies"})

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
    """Read a scheme from a text file of rows `i0 w0 i1 w1 i2 w2`, or with the spread in metres as a seventh number.

    Args:
        path: the file.
        template: the model's template vertices, metres; tell the order of the rows of scheme 68.
        name: of the scheme; None: NAME of the file `head_sparse_NAME.txt`.

    Raises:
        InputError: the file has other rows, a vertex index is out of range, weights do not sum to one, a spread is not
            positive, or the header states a later version.
    """
    path = Path(path)
    text = read_text(path, partial(InputError, "The landmark scheme cannot be read", where=path, fix=_FIX))
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    header = _header([line for line in lines if line.startswith("#")], path)
    indices, weights, spread = _table([line for line in lines if not line.startswith("#")], path, len(template))
    name = name or path.stem.removeprefix(_PREFIX)
    scheme = LandmarkScheme(name=name, indices=indices, weights=weights, spread_m=spread, header=header)
    if name != jaw_order.SCHEME or not jaw_order.is_reversed(scheme.points(template.astype(np.float64))):
        return scheme
    order = jaw_order.TURNED
    return replace(
        scheme,
        indices=indices[order],
        weights=weights[order],
        spread_m=None if spread is None else spread[order],
        reversed_in_file=True,
    )


def _header(comments: list[str], path: Path) -> dict[str, str]:
    entries = dict(line.lstrip("#").strip().split(": ", 1) for line in comments if ": " in line)
    version = entries.get("version", str(VERSION))
    if entries.get("kind") == KIND and version != str(VERSION):
        raise _input_error("has a version that this project does not know", path, f"version {VERSION}", version)
    return entries


def _table(
    lines: list[str], path: Path, vertex_count: int
) -> tuple[Int[np.ndarray, "L 3"], Float[np.ndarray, "L 3"], Float[np.ndarray, "L"] | None]:
    """Indices, weights and spreads of a file's rows. Raises InputError."""
    try:
        rows = [[float(word) for word in line.split()] for line in lines]
    except ValueError as error:
        raise _input_error("cannot be read", path, "rows of six or seven numbers", error) from None
    for number, row in enumerate(rows):
        if len(row) not in (6, 7) or not np.isfinite(row).all():
            raise _input_error("has a wrong row", path, "six finite numbers, or seven", f"{row} in row {number}")
        if len(row) != len(rows[0]):
            got = f"{len(row)} in row {number}, {len(rows[0])} in row 0"
            raise _input_error("has spreads in some rows only", path, "as many numbers in every row", got)
    if not rows:
        raise _input_error("is empty", path, "at least one row", "none")
    table = np.array(rows)
    indices, weights = table[:, 0:6:2], table[:, 1:6:2]
    bad = np.flatnonzero(((indices < 0) | (indices >= vertex_count) | (indices != np.round(indices))).any(1))
    if len(bad):
        got = f"{indices[bad[0]].tolist()} in row {bad[0]}"
        raise _input_error("has a wrong vertex index", path, f"indices of the model's {vertex_count} vertices", got)
    bad = np.flatnonzero(np.abs(weights.sum(1) - 1) > 0.01)
    if len(bad):
        got = f"{weights[bad[0]]} in row {bad[0]}"
        raise _input_error("has wrong weights", path, "three weights that sum to 1", got)
    weights = weights / weights.sum(1, keepdims=True)  # the files round to three digits
    spread = table[:, 6] if table.shape[1] == 7 else None
    if spread is not None and not ((spread > 0) & (spread < _MAX_SPREAD_M)).all():
        first = int(np.flatnonzero(~((spread > 0) & (spread < _MAX_SPREAD_M)))[0])
        got = f"{spread[first]} in row {first}"
        raise _input_error("has a wrong spread", path, f"a number of metres above 0 and below {_MAX_SPREAD_M}", got)
    return indices.astype(np.int64), weights, spread


def schemes_beside(model_path: Path, template: Float[np.ndarray, "V 3"]) -> dict[str, LandmarkScheme]:
    """Read all schemes `head_sparse_NAME.txt` in the model file's folder, by name. Raises InputError."""
    files = sorted(Path(model_path).parent.glob(f"{_PREFIX}*.txt"))
    return {scheme.name: scheme for scheme in (read_scheme(file, template) for file in files)}


def shipped_schemes(data: gnm_npz.GNMData) -> dict[str, LandmarkScheme]:
    """Read the landmark maps of this package for a model's topology, by name.

    They are the files `NAME.TOPOLOGY.txt` of `landmark_maps`, with the first digits of the hash of the model's
    triangles (`gnm_npz.topology_hash`). Raises InputError if a file is damaged.
    """
    files = sorted(SHIPPED.glob(f"*.{gnm_npz.topology_hash(data.triangles)[:_TOPOLOGY_DIGITS]}.txt"))
    names = {file: file.name.split(".", 1)[0] for file in files}
    return {
        name: replace(read_scheme(file, data.template_vertex_positions, name), shipped=True)
        for file, name in names.items()
    }


def shipped_file(name: str, topology: str) -> Path:
    """Return where the shipped map of a scheme for a topology (`gnm_npz.topology_hash`) lies, or would lie."""
    return SHIPPED / f"{name}.{topology[:_TOPOLOGY_DIGITS]}.txt"


def check_topology(scheme: LandmarkScheme, data: gnm_npz.GNMData, path: object) -> None:
    """Check that a map whose header states a topology was made for this model's. Raises InputError."""
    stated, own = scheme.header.get("topology"), gnm_npz.topology_hash(data.triangles)
    if stated is not None and stated != own:
        raise InputError(
            "The landmark map is of another topology",
            where=path,
            expected=f"topology {own[:_TOPOLOGY_DIGITS]}, the model's",
            got=stated[:_TOPOLOGY_DIGITS],
            fix="make a map of this model with `gnmreg model landmarks`",
        )


def write_scheme(scheme: LandmarkScheme, model_path: Path) -> Path:
    """Write a scheme as `head_sparse_NAME.txt` into a model file's folder. Returns its path."""
    return write_scheme_file(scheme, scheme_file(model_path, scheme.name))


def scheme_file(model_path: Path, name: str) -> Path:
    """Return where a scheme of a model lies: `head_sparse_NAME.txt` beside its file."""
    return Path(model_path).with_name(f"{_PREFIX}{name}.txt")


def write_scheme_file(scheme: LandmarkScheme, path: Path) -> Path:
    """Write a scheme, its header first, to a file in one rename. Returns its path."""
    rows = zip(scheme.indices.tolist(), scheme.weights.tolist(), strict=True)
    lines = [" ".join(f"{i} {w:.9g}" for i, w in zip(index, weight, strict=True)) for index, weight in rows]
    if scheme.spread_m is not None:
        lines = [f"{line} {spread:.4g}" for line, spread in zip(lines, scheme.spread_m.tolist(), strict=True)]
    header = [f"# {name}: {value}" for name, value in scheme.header.items()]
    with atomic_file(Path(path)) as target:
        target.write_text("\n".join([*header, *lines]) + "\n", "ascii")
    return Path(path)


def _input_error(what: str, path: Path, expected: object, got: object) -> InputError:
    return InputError(f"The landmark scheme {what}", where=path, expected=expected, got=got, fix=_FIX)
