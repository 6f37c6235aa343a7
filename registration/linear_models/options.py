"""What a user may say of a model's file that the file does not."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from registration.linear_models.data import LinearModelData

Axis = Literal["+x", "-x", "+y", "-y", "+z", "-z"]


@dataclass(frozen=True, kw_only=True)
class ReadOptions:
    """Options of reading a model; None: what the file states, or else the convention of its format."""

    without_jaw: bool = False  # drop the jaw's joint: the expressions alone open the mouth, as in GNM
    identity_components: int | None = None  # of a file with one basis for both; the others are expressions
    unit_m: float | None = None  # metres per unit of the file
    up: Axis | None = None  # the file's axis towards the top of the head
    front: Axis | None = None  # the file's axis out of the face


@dataclass(frozen=True, kw_only=True)
class ModelFormat:
    """A format of model files."""

    name: str
    title: str  # in words, for tables and messages
    detect: Callable[[Path], bool]  # by content, never by name
    read: Callable[[Path, ReadOptions], LinearModelData]
