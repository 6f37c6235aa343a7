"""Results of single samples of a comparison of models: one NPZ file each, so that a comparison resumes."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from coregister.evaluate.face_protocol import SampleResult
from registration.errors import InputError
from registration.storage.files import atomic_file
from registration.storage.npz import NpzSchema

_DISTANCE, _CURVE = "distance_", "curve_"
SCHEMA = NpzSchema(
    title="result of a sample",
    fix="delete it and compare again",
    fields={
        "key": ("text", ""),
        "members": ("bool", "R N"),
        "nearest": ("integer", "N"),
        "stages": ("text", "S"),
        "rms_mm": ("float", "S"),
        "converged": ("bool", "S"),
        "largest": ("float", ""),
        "left_out": ("integer", ""),
    },
    families={_DISTANCE: ("float", "N"), _CURVE: ("float", "K")},
    finite=False,
    max_bytes=2**28,
)


def write_result(result: SampleResult, key: str, file: Path) -> None:
    """Write a result in one rename.

    Args:
        result: to be written.
        key: digest of all that determines it.
        file: its path; the folder must exist.
    """
    stages = list(result.distances_mm)
    arrays: Mapping[str, np.ndarray] = {
        "key": np.array(key),
        "members": result.members,
        "nearest": result.nearest,
        "stages": np.array(stages),
        "rms_mm": np.array([result.rms_mm[name] for name in stages]),
        "converged": np.array([result.converged[name] for name in stages]),
        "largest": np.array(result.largest),
        "left_out": np.array(result.left_out),
        **{_DISTANCE + name: values for name, values in result.distances_mm.items()},
        **{_CURVE + name: values for name, values in result.curves_mm.items()},
    }
    with atomic_file(file) as temporary, temporary.open("wb") as stream:
        np.savez_compressed(stream, allow_pickle=False, **arrays)


def read_result(file: Path, key: str) -> SampleResult | None:
    """Read a result; None if there is none, or that of other input: it has to be computed.

    Raises:
        InputError: the file is damaged or no result.
    """
    if not file.is_file():
        return None
    arrays = SCHEMA.read(file)
    if str(arrays["key"]) != key:
        return None
    stages = [str(name) for name in arrays["stages"]]
    count = len(arrays["nearest"])
    if any(len(arrays.get(_DISTANCE + name, ())) != count for name in stages):
        raise InputError(
            "The result of a sample is incomplete",
            where=file,
            expected=f"{count} distances of {', '.join(stages)}",
            got=", ".join(arrays),
            fix=SCHEMA.fix,
        )
    return SampleResult(
        distances_mm={name: arrays[_DISTANCE + name] for name in stages},
        rms_mm=dict(zip(stages, arrays["rms_mm"].tolist(), strict=True)),
        members=arrays["members"],
        nearest=arrays["nearest"],
        curves_mm={n.removeprefix(_CURVE): v for n, v in arrays.items() if n.startswith(_CURVE)},
        converged=dict(zip(stages, arrays["converged"].tolist(), strict=True)),
        largest=float(arrays["largest"]),
        left_out=int(arrays["left_out"]),
    )
