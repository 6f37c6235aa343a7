"""The auxiliary model of whole heads that completes a cranium, and its file [GNM, Head Registration].

See docs/algorithms.md, "Cranium", and docs/formats.md, "Auxiliary model of the cranium".
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from registration.errors import InputError
from registration.model.gnm_npz import GNMData, topology_hash
from registration.storage.files import atomic_file
from registration.storage.npz import NpzSchema

FILE = "head_cranium.npz"  # beside the models of its topology, as landmark schemes are
KIND = "gnm-cranium-model 1"
_FIX = "make it with `gnmreg model cranium MODEL`"
SCHEMA = NpzSchema(
    title="auxiliary model of the cranium",
    fix=_FIX,
    fields={
        "kind": ("text", ""),
        "topology": ("text", ""),
        "mean": ("float", "V 3"),
        "basis": ("float", "R V 3"),
        "residual": ("float", "V"),
        "noise": ("float", ""),
        "heads": ("integer", ""),
        "seed": ("integer", ""),
        "source": ("text", ""),
        "tried_ranks": ("integer", "T"),
        "tried_noises": ("float", "T"),
        "tried_errors": ("float", "T"),
    },
    never_empty="RVT",
    max_bytes=2**31,
)


@dataclass(frozen=True, kw_only=True, eq=False)
class CraniumModel:
    """A Gaussian model of whole heads of one topology, aligned by their faces. Metres, the head model's frame.

    V vertices, R components, T settings tried.
    """

    topology: str  # `gnm_npz.topology_hash` of the triangles
    mean: Float[np.ndarray, "V 3"]
    basis: Float[np.ndarray, "R V 3"]  # per standard deviation; zero off the exterior
    residual: Float[np.ndarray, "V"]  # rms distance of the heads from their best approximations by the basis
    noise: float  # standard deviation of a square centimetre of observed skin from such an approximation
    heads: int  # that it was made from
    seed: int  # of the heads; -1: they were files
    source: str  # of the heads, for people
    tried_ranks: Int[np.ndarray, "T"]  # with the next two: the settings that leave-one-out chose from
    tried_noises: Float[np.ndarray, "T"]  # metres
    tried_errors: Float[np.ndarray, "T"]  # rms error of the left-out head's hidden cranium, metres

    def __post_init__(self) -> None:
        assert self.basis.shape[1:] == self.mean.shape

    @property
    def rank(self) -> int:
        """Number of components."""
        return len(self.basis)


def beside(model_path: Path) -> Path:
    """Return where the auxiliary model of a head model's file lies."""
    return Path(model_path).parent / FILE


def find(model_path: Path, data: GNMData) -> CraniumModel | None:
    """Return the auxiliary model beside a head model's file, or None if there is none.

    Raises:
        InputError: as `read`.
    """
    file = beside(model_path)
    return read(file, data) if file.exists() else None


def read(file: Path, data: GNMData) -> CraniumModel:
    """Read an auxiliary model.

    Args:
        file: an NPZ file that `write` wrote.
        data: the head model whose topology it must have.

    Raises:
        InputError: the file cannot be read, a field is missing or has a wrong type, shape or value, or it has another
            topology than the head model.
    """
    arrays = SCHEMA.read(file)
    if (kind := str(arrays["kind"])) != KIND:
        raise InputError(
            "The auxiliary model of the cranium is of another kind or version",
            where=file,
            expected=KIND,
            got=kind[:80],
            fix=_FIX,
        )
    wanted, count = topology_hash(data.triangles), len(data.template_vertex_positions)
    if str(arrays["topology"]) != wanted or len(arrays["mean"]) != count:
        raise InputError(
            "The auxiliary model of the cranium has another topology than the head model",
            where=file,
            expected=f"{count} vertices, topology {wanted[:16]}",
            got=f"{len(arrays['mean'])} vertices, topology {str(arrays['topology'])[:16]}",
            fix=_FIX,
        )
    if not (arrays["noise"] > 0 and (arrays["residual"] >= 0).all()):
        raise InputError(
            "The auxiliary model of the cranium has no standard deviations",
            where=file,
            expected="noise > 0 and residual >= 0",
            got=f"noise {float(arrays['noise']):g}, residual from {arrays['residual'].min():g}",
            fix=_FIX,
        )
    return CraniumModel(
        topology=wanted,
        mean=arrays["mean"].astype(np.float64),
        basis=arrays["basis"].astype(np.float64),
        residual=arrays["residual"].astype(np.float64),
        noise=float(arrays["noise"]),
        heads=int(arrays["heads"]),
        seed=int(arrays["seed"]),
        source=str(arrays["source"]),
        tried_ranks=arrays["tried_ranks"],
        tried_noises=arrays["tried_noises"].astype(np.float64),
        tried_errors=arrays["tried_errors"].astype(np.float64),
    )


def write(model: CraniumModel, file: Path) -> None:
    """Write an auxiliary model in one rename; arrays as float32."""
    arrays = {
        "kind": np.array(KIND),
        "topology": np.array(model.topology),
        **{name: getattr(model, name).astype(np.float32) for name in ("mean", "basis", "residual")},
        "noise": np.array(model.noise, np.float32),
        "heads": np.array(model.heads),
        "seed": np.array(model.seed),
        "source": np.array(model.source),
        "tried_ranks": np.asarray(model.tried_ranks, np.int64),
        "tried_noises": np.asarray(model.tried_noises, np.float32),
        "tried_errors": np.asarray(model.tried_errors, np.float32),
    }
    file = Path(file)
    file.parent.mkdir(parents=True, exist_ok=True)
    with atomic_file(file) as temporary, temporary.open("wb") as stream:
        np.savez_compressed(stream, allow_pickle=False, **arrays)
