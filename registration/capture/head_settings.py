"""The parts of `capture.toml` that a capture without photographs needs."""

from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from registration.errors import InputError
from registration.types import HeadPose

_HEAD = {"rotation": 9, "translation": 3}  # how many numbers each has
_MAX_TURN = 1e-3  # by which a rotation may differ from an orthogonal matrix


def read_photographs(path: Path, settings: Mapping[str, Any]) -> bool:
    """Return whether the images' colours count. Raises InputError for what is no truth value."""
    value = settings.get("photographs", True)
    if not isinstance(value, bool):
        fix = "write false if the images do not show the subject's colours"
        raise InputError("A setting is no truth value", where=path, expected="true or false", got=value, fix=fix)
    return value


def read_head_pose(path: Path, settings: Mapping[str, Any]) -> HeadPose | None:
    """Return the pose in the table `[head]`, if there is one. Raises InputError for numbers that are no pose."""
    table = settings.get("head")
    if table is None:
        return None
    refuse = partial(
        InputError,
        "The table [head] is malformed",
        where=path,
        expected="rotation (9 numbers, row by row), translation (3, metres), scale (1, above 0)",
        fix="see the capture folder in docs/formats.md, or remove the table",
    )
    if not isinstance(table, Mapping):
        raise refuse(got=table)
    if set(table) - {*_HEAD, "scale"} or not {*_HEAD} <= set(table):
        raise refuse(got=", ".join(table))
    for name, count in _HEAD.items():
        values = table[name]
        if not isinstance(values, list) or len(values) != count or not all(type(v) in (int, float) for v in values):
            raise refuse(got=f"{name} = {values}")
    scale = table.get("scale", 1.0)
    if type(scale) not in (int, float) or not 0 < scale < 1e3:
        raise refuse(got=f"scale = {scale}")
    rotation = np.array(table["rotation"], np.float64).reshape(3, 3)
    if np.abs(rotation @ rotation.T - np.eye(3)).max() > _MAX_TURN or np.linalg.det(rotation) < 0:
        raise refuse(got=f"a matrix that is no rotation: {table['rotation']}")
    return HeadPose(rotation=rotation, translation=np.array(table["translation"], np.float64), scale=float(scale))
