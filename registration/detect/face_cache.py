"""Small files of the faces of one image. A damaged file is as none: the faces are detected again."""

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from registration.detect.provider import Face
from registration.errors import InputError
from registration.storage.cache import make_cache_folder
from registration.storage.files import DiskFull, atomic_file
from registration.storage.npz import NpzSchema

_SCHEMA = NpzSchema(
    title="cached faces",
    fix="remove the file",
    fields={
        "points": ("float", "F L 2"),
        "confidence": ("float", "F L"),
        "spread_px": ("float", "F L"),
        "presence": ("float", "F"),
        "box": ("float", "F 4"),
        "roll": ("float", "F"),
        "hints": ("text", "F"),
    },
    max_bytes=2**26,
)


def read(file: Path, count: int) -> tuple[Face, ...] | None:
    """Return the faces in a file; None if there is no file, or one that is damaged or of another number of points."""
    if not file.is_file():
        return None
    try:
        arrays = _SCHEMA.read(file)
        hints = [dict(json.loads(str(text))) for text in arrays["hints"]]
        if len(hints) and arrays["points"].shape[1] != count:
            return None
        return tuple(
            Face(
                points=arrays["points"][k].astype(np.float64),
                confidence=arrays["confidence"][k].astype(np.float64),
                spread_px=arrays["spread_px"][k].astype(np.float64),
                presence=float(arrays["presence"][k]),
                box=arrays["box"][k].astype(np.float64),
                roll=float(arrays["roll"][k]),
                hints={str(name): float(score) for name, score in hints[k].items()},
            )
            for k in range(len(hints))
        )
    except (InputError, OSError, ValueError, TypeError):
        return None


def write(file: Path, faces: Sequence[Face]) -> None:
    """Write faces; a cache that cannot be written is no error."""

    def stacked(name: str, *shape: int) -> np.ndarray:
        return np.array([getattr(face, name) for face in faces], np.float64).reshape(len(faces), *shape)

    count = len(faces[0].points) if faces else 0
    try:
        make_cache_folder(file.parent)
        with atomic_file(file) as temporary, open(temporary, "wb") as stream:
            np.savez(
                stream,
                points=stacked("points", count, 2),
                confidence=stacked("confidence", count),
                spread_px=stacked("spread_px", count),
                presence=stacked("presence"),
                box=stacked("box", 4),
                roll=stacked("roll"),
                hints=np.array([json.dumps(dict(face.hints)) for face in faces], np.str_),
            )
    except (InputError, OSError, DiskFull):
        return
