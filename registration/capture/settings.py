"""Read `capture.toml`: subject, expression, units, tags and the names of the label classes."""

import difflib
import os
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, get_args

from registration.capture.colour_settings import ColourSettings, read_colours
from registration.capture.head_settings import read_head_pose, read_photographs
from registration.capture.label_settings import read_labels_table
from registration.errors import InputError
from registration.storage.reading import parse_toml, read_bytes
from registration.types import HeadPose, LabelCode, NormalsFrame

UNITS_M = {"m": 1.0, "mm": 1e-3, "cm": 1e-2, "dm": 0.1, "km": 1e3, "in": 0.0254, "inch": 0.0254, "ft": 0.3048}
_RESERVED = ("subject", "expression", "units", "segmentation", "normals", "depth", "photographs", "head", "colour")


@dataclass(frozen=True, kw_only=True)
class CaptureSettings:
    """The contents of `capture.toml`."""

    subject: str
    expression: str
    units: str  # "m", unless others are asked for
    classes: tuple[str, ...]  # as `class_names.meaning` spells them, each once
    labels: LabelCode
    colours: ColourSettings
    tags: Mapping[str, Any]
    normals_frame: NormalsFrame = "camera_opencv"
    depth_unit_m: float | None = None
    photographs: bool = True
    head: HeadPose | None = None


def read_settings(path: Path, inside: Callable[[Path], Path] = Path, *, any_unit: bool = False) -> CaptureSettings:
    """Read `capture.toml` (docs/formats.md).

    Args:
        path: of the file.
        inside: returns the path of a file that it names if it lies within the capture; raises InputError if not.
        any_unit: accept other units than metres.

    Raises:
        InputError: the file is missing or no TOML, or a required key is missing, misspelt or malformed.
    """

    def refuse(
        what: str, expected: object, got: object, fix: str = "see the capture folder in docs/formats.md"
    ) -> InputError:
        return InputError(what, where=path, expected=expected, got=got, fix=fix)

    if not os.path.lexists(path):
        fix = "convert the files of another program with gnmreg capture import; or write it as docs/formats.md says"
        raise refuse("capture.toml is missing", "subject, expression and units", "no such file", fix)
    unreadable = partial(refuse, "capture.toml cannot be read")
    settings = parse_toml(read_bytes(path, unreadable), unreadable)
    for key in ("subject", "expression"):
        if not isinstance(settings.get(key), str):
            got = settings.get(key, _misspelt(key, settings))
            raise refuse(f'capture.toml lacks "{key}"', f'{key} = "..."', got)
    if settings.get("units") != "m" and not any_unit:
        got = settings.get("units", _misspelt("units", settings))
        factor = UNITS_M.get(str(got).lower())
        by = f"scale the COLMAP model, the scan and the ground truth by {factor:g}, and " if factor else ""
        scale = f"{'' if factor == 1 else by}write "
        raise refuse("The units are not metres", 'units = "m"', got, f'{scale}units = "m"; see docs/formats.md')
    tables = [key for key, value in settings.items() if isinstance(value, dict)]
    for name in ("segmentation", "colour"):
        if name not in settings and (near := _nearest(name, tables)) is not None:
            fix = f"rename the table to [{name}]; if it is a tag, give it another name"
            raise refuse("A table of capture.toml is misspelt", f"[{name}]", f"[{near}]", fix)
    classes, labels = _labels(path, settings.get("segmentation", {}), inside)
    return CaptureSettings(
        subject=settings["subject"],
        expression=settings["expression"],
        units=str(settings.get("units", "")),
        classes=classes,
        labels=labels,
        colours=read_colours(path, settings.get("colour", {})),
        tags={key: value for key, value in settings.items() if key not in _RESERVED},
        normals_frame=_normals_frame(path, settings.get("normals", {})),
        depth_unit_m=_depth_unit(path, settings.get("depth", {})),
        photographs=read_photographs(path, settings),
        head=read_head_pose(path, settings),
    )


def _labels(path: Path, segmentation: object, inside: Callable[[Path], Path]) -> tuple[tuple[str, ...], LabelCode]:
    """The classes of the label maps and the code of their pixels. Raises InputError."""

    def refuse(what: str, expected: str, got: object) -> InputError:
        return InputError(what, where=path, expected=expected, got=got, fix="see the capture folder in docs/formats.md")

    if not isinstance(segmentation, dict):
        raise refuse("The segmentation classes are malformed", 'classes = ["background", ...]', segmentation)
    if "classes" not in segmentation and (near := _nearest("classes", segmentation, ("labels", "names"))) is not None:
        raise refuse("[segmentation] lacks the class names", 'classes = ["background", ...]', f"{near} = ...")
    return read_labels_table(path, segmentation, inside)


def _normals_frame(path: Path, normals: object) -> NormalsFrame:
    """The axes of the normal maps. Raises InputError."""
    frames: tuple[NormalsFrame, ...] = get_args(NormalsFrame)
    table = normals if isinstance(normals, dict) else {"normals": normals}
    stated, unknown = table.get("frame", frames[0]), sorted(set(table) - {"frame"})
    if stated not in frames or unknown:
        raise InputError(
            "The axes of the normals are stated wrongly",
            where=path,
            expected="[normals] with " + " or ".join(f'frame = "{frame}"' for frame in frames),
            got=f"{unknown[0]} = ..." if unknown else repr(stated),
            fix="see the capture folder in docs/formats.md",
        )
    return frames[frames.index(stated)]


def _depth_unit(path: Path, depth: object) -> float | None:
    """Metres per unit of the depth maps, None if it is not stated. Raises InputError."""
    if depth == {}:
        return None
    unit = depth.get("unit") if isinstance(depth, dict) and len(depth) == 1 else None
    if not isinstance(unit, str) or unit not in UNITS_M:
        raise InputError(
            "The unit of the depth maps is stated wrongly",
            where=path,
            expected=f"[depth] with unit = one of {', '.join(UNITS_M)}",
            got=depth,
            fix="see the capture folder in docs/formats.md",
        )
    return UNITS_M[unit]


def _misspelt(key: str, settings: Iterable[str]) -> str:
    near = _nearest(key, settings)
    return "nothing" if near is None else f'nothing; is "{near}" meant?'


def _nearest(key: str, keys: Iterable[str], aliases: tuple[str, ...] = ()) -> str | None:
    """The key that is probably a misspelling of `key`."""
    by_name = {name.casefold(): name for name in keys}
    found = [*(alias for alias in aliases if alias in by_name), *difflib.get_close_matches(key, by_name, 1, 0.75)]
    return by_name[found[0]] if found else None
