"""The file of a map between topologies. See docs/formats.md, "Maps between topologies"."""

from pathlib import Path
from typing import cast

import numpy as np

from registration.errors import InputError
from registration.storage.files import atomic_file
from registration.storage.npz import Kind, NpzSchema
from registration.topology_map.topology_map import Status, SurfacePoints, TopologyMap

KIND = "gnm-topology-map 1"
_FIX = "make it with `gnmreg model map`"
_SIDES = {"": "B", "back_": "A"}  # prefix of the fields of a side -> axis of its vertices


def _side(prefix: str, axis: str) -> dict[str, tuple[Kind, str]]:
    return {
        f"{prefix}triangle": ("integer", axis),
        f"{prefix}barycentric": ("float", f"{axis} 3"),
        f"{prefix}distance_m": ("float", axis),
        f"{prefix}mask": ("bool", axis),
        f"{prefix}offset": ("float", f"{axis} 3"),
    }


SCHEMA = NpzSchema(
    title="map between topologies",
    fix=_FIX,
    fields={
        "kind": ("text", ""),
        "source_triangles": ("integer", "F 3"),
        "target_triangles": ("integer", "G 3"),
        **_side("", "B"),
        **_side("back_", "A"),
        "scale": ("float", ""),
        "rotation": ("float", "3 3"),
        "translation": ("float", "3"),
        "status": ("text", ""),
        "reasons": ("text", "R"),
        "figure_names": ("text", "N"),
        "figure_values": ("float", "N"),
    },
    indices={"source_triangles": "A", "target_triangles": "B", "triangle": "F", "back_triangle": "G"},
    never_empty="ABFG",
    max_bytes=2**30,
)


def read(file: Path) -> TopologyMap:
    """Read a map; `TopologyMap.check` tells whether it is of given meshes.

    Raises:
        InputError: the file cannot be read, is of another kind, or a field is missing or has a wrong type, shape or
            value.
    """
    arrays = SCHEMA.read(file)
    if (kind := str(arrays["kind"])) != KIND:
        raise _error("is of another kind or version", file, KIND, kind[:80])
    status = str(arrays["status"])
    if status not in ("accepted", "refused"):
        raise _error("has an unknown status", file, "accepted or refused", status[:80])
    sides = {prefix: _read_side(arrays, prefix, file) for prefix in _SIDES}
    rotation = arrays["rotation"].astype(np.float64)
    if not (arrays["scale"] > 0 and np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-6)):
        got = f"scale {float(arrays['scale']):g}, rotation {rotation.tolist()}"
        raise _error("has no similarity transform", file, "a positive scale and a rotation", got)
    names = [str(name) for name in arrays["figure_names"]]
    return TopologyMap(
        source_triangles=arrays["source_triangles"].astype(np.int64),
        target_triangles=arrays["target_triangles"].astype(np.int64),
        points=sides[""],
        back=sides["back_"],
        scale=float(arrays["scale"]),
        rotation=rotation,
        translation=arrays["translation"].astype(np.float64),
        status=cast(Status, status),
        reasons=tuple(str(reason) for reason in arrays["reasons"]),
        figures=dict(zip(names, arrays["figure_values"].astype(float).tolist(), strict=True)),
    )


def _read_side(arrays: dict[str, np.ndarray], prefix: str, file: Path) -> SurfacePoints:
    share, distance = arrays[f"{prefix}barycentric"].astype(np.float64), arrays[f"{prefix}distance_m"]
    if (share < -1e-5).any() or (np.abs(share.sum(1) - 1) > 1e-4).any() or (distance < 0).any():
        got = f"sums from {share.sum(1).min():g} to {share.sum(1).max():g}, distances from {distance.min():g}"
        expected = "barycentrics >= 0 that sum to 1, distances >= 0"
        raise _error(f"has wrong values in '{prefix}barycentric' or '{prefix}distance_m'", file, expected, got)
    return SurfacePoints(
        triangle=arrays[f"{prefix}triangle"].astype(np.int64),
        barycentric=share,
        distance_m=distance.astype(np.float64),
        mask=arrays[f"{prefix}mask"],
        offset=arrays[f"{prefix}offset"].astype(np.float64),
    )


def write(mapped: TopologyMap, file: Path) -> None:
    """Write a map in one rename; numbers of a vertex as float32."""
    arrays = {
        "kind": np.array(KIND),
        "source_triangles": mapped.source_triangles.astype(np.int32),
        "target_triangles": mapped.target_triangles.astype(np.int32),
        **{
            f"{prefix}{name}": value
            for prefix, side in (("", mapped.points), ("back_", mapped.back))
            for name, value in _arrays(side).items()
        },
        "scale": np.array(mapped.scale),
        "rotation": mapped.rotation,
        "translation": mapped.translation,
        "status": np.array(mapped.status),
        "reasons": np.array(mapped.reasons, dtype=str) if mapped.reasons else np.zeros(0, "U1"),
        "figure_names": np.array(list(mapped.figures), dtype=str),
        "figure_values": np.array(list(mapped.figures.values()), np.float64),
    }
    file = Path(file)
    file.parent.mkdir(parents=True, exist_ok=True)
    with atomic_file(file) as temporary, temporary.open("wb") as stream:
        np.savez_compressed(stream, allow_pickle=False, **arrays)


def _arrays(side: SurfacePoints) -> dict[str, np.ndarray]:
    return {
        "triangle": side.triangle.astype(np.int32),
        "barycentric": side.barycentric.astype(np.float32),
        "distance_m": side.distance_m.astype(np.float32),
        "mask": side.mask,
        "offset": side.offset.astype(np.float32),
    }


def _error(what: str, file: Path, expected: object, got: object) -> InputError:
    return InputError(f"The map between topologies {what}", where=file, expected=expected, got=got, fix=_FIX)
