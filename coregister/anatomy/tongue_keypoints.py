"""Recordings of named points in a speaker's mouth over time, by electromagnetic articulography [Medina 2022].

The file's format: docs/formats.md, "Key points of the tongue".
"""

import csv
from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Int

from registration.errors import InputError
from registration.geometry.rigid import align
from registration.storage.npz import Defect, NpzSchema
from registration.storage.reading import Refuse, read_text

TONGUE_POINTS = ("tongue_tip", "tongue_blade", "tongue_dorsum", "tongue_left", "tongue_right")
REQUIRED = ("upper_incisors", "tongue_tip", "tongue_blade", "tongue_dorsum")
HEAD_POINTS = ("upper_incisors", "nasion", "left_mastoid", "right_mastoid")  # fixed to the skull
OTHER_POINTS = ("lower_incisors", "upper_lip", "lower_lip", "left_mouth_corner", "right_mouth_corner")
POINTS = (*HEAD_POINTS, *TONGUE_POINTS, *OTHER_POINTS)
_HEADER = ("time_s", "point", "x_mm", "y_mm", "z_mm")
_TITLE, _FIX = "recording of the tongue", 'see docs/formats.md, "Key points of the tongue"'
_SCHEMA = NpzSchema(
    title=_TITLE,
    fix=_FIX,
    fields={"names": ("text", "P"), "time_s": ("float", "T"), "points_mm": ("float", "T P 3")},
    never_empty="PT",
    finite=False,  # a point that was not measured is NaN
    max_bytes=2**30,
)
_MAX_ROWS = 2_000_000
_MAX_COORDINATE_MM = 1e5
_REACH = 3.0  # standard deviations that smoothing in time looks back and ahead
_TIP_DISTANCE_MM = 3.0, 120.0  # plausible median distance of the tip from the upper incisors


@dataclass(frozen=True, kw_only=True, eq=False)
class TongueRecording:
    """T times of named points in millimetres: +X the subject's left, +Y up, +Z out of the mouth; NaN: not measured."""

    time_s: Float[np.ndarray, "T"]
    points: Mapping[str, Float[np.ndarray, "T 3"]]

    @property
    def complete(self) -> Bool[np.ndarray, "T"]:
        """Times at which all required points were measured."""
        return np.all([np.isfinite(self.points[name]).all(1) for name in REQUIRED], axis=0)

    def smoothed(self, times: Int[np.ndarray, "N"], deviation_s: float) -> "TongueRecording":
        """Return some times, each a weighted mean of those around it; a point that was not measured then stays so.

        Args:
            times: indices.
            deviation_s: standard deviation of the Gaussian weights, seconds. A time without others as near is kept.
        """
        points = {name: np.array(place[times]) for name, place in self.points.items()}
        for row, time in enumerate(self.time_s[times].tolist()):
            away = (self.time_s - time) / deviation_s
            near = np.flatnonzero(np.abs(away) <= _REACH)
            weights = np.exp(-0.5 * away[near] ** 2)
            for name, place in self.points.items():
                known = np.isfinite(place[near]).all(1)
                if np.isfinite(points[name][row]).all():
                    points[name][row] = weights[known] @ place[near][known] / weights[known].sum()
        return TongueRecording(time_s=self.time_s[times], points=points)


def read_recording(file: Path) -> TongueRecording:
    """Read a recording and take the head's motion out of it; the origin becomes the upper incisors.

    Where the file has three or more points fixed to the skull, the head is aligned rigidly at every time with the
    median configuration of these; with fewer, only the position of the upper incisors is subtracted.

    Args:
        file: CSV or NPZ, by its suffix.

    Raises:
        InputError: the file cannot be read; a point has an unknown name or comes twice; upper incisors or a point of
            the tongue are missing; no time has them all; or lengths are not in millimetres.
    """
    file = Path(file)
    if file.suffix.lower() == ".npz":
        time, points = _read_npz(file)
    elif file.suffix.lower() == ".csv":
        time, points = _read_csv(file)
    else:
        raise InputError.unreadable(
            _TITLE, where=file, expected="a file .csv or .npz", got=file.suffix or "no suffix", fix=_FIX
        )
    refuse = partial(InputError.unreadable, _TITLE, where=file, fix=_FIX)
    _check(points, refuse)
    recording = TongueRecording(time_s=time, points=_without_head_motion(points))
    if not recording.complete.any():
        counts = ", ".join(f"{name} at {int(np.isfinite(points[name]).all(1).sum())}" for name in REQUIRED)
        raise refuse(expected=f"a time with all of {', '.join(REQUIRED)}", got=f"of {len(time)} times: {counts}")
    distance = float(np.median(np.linalg.norm(recording.points["tongue_tip"][recording.complete], axis=1)))
    low, high = _TIP_DISTANCE_MM
    if not low <= distance <= high:
        expected = f"millimetres: a tongue's tip {low:.0f} to {high:.0f} mm from the upper incisors"
        raise refuse(expected=expected, got=f"{distance:.4g} in the median")
    return recording


def _check(points: Mapping[str, Float[np.ndarray, "T 3"]], refuse: Refuse) -> None:
    if "upper_incisors" not in points:
        expected = "the point 'upper_incisors', by which the recording is aligned with the model"
        raise refuse(expected=expected, got=f"{len(points)} points: {', '.join(points) or 'none'}")
    if missing := [name for name in REQUIRED if name not in points]:
        raise refuse(expected=f"the points {', '.join(REQUIRED)}", got=f"without {', '.join(missing)}")
    if unknown := [name for name in points if name not in POINTS]:
        raise refuse(expected=f"points of {', '.join(POINTS)}", got=", ".join(unknown))
    for name, place in points.items():
        if (largest := np.abs(place[np.isfinite(place)]).max(initial=0)) > _MAX_COORDINATE_MM or np.isinf(place).any():
            raise refuse(expected=f"coordinates of '{name}' up to {_MAX_COORDINATE_MM:.0f} mm", got=f"{largest:.4g}")


def _read_npz(file: Path) -> tuple[Float[np.ndarray, "T"], dict[str, Float[np.ndarray, "T 3"]]]:
    arrays = _SCHEMA.read(file)
    names, time = arrays["names"].tolist(), arrays["time_s"].astype(np.float64)
    if len(set(names)) < len(names):
        raise _SCHEMA.error(Defect(name="names", what="value", expected="different names", got=names), file)
    if not np.isfinite(time).all():
        raise _SCHEMA.error(Defect(name="time_s", what="value", expected="finite times", got="others"), file)
    values = arrays["points_mm"].astype(np.float64)
    return time, {name: values[:, k] for k, name in enumerate(names)}


def _read_csv(file: Path) -> tuple[Float[np.ndarray, "T"], dict[str, Float[np.ndarray, "T 3"]]]:
    refuse = partial(InputError.unreadable, _TITLE, where=file, fix=_FIX)
    lines = read_text(file, refuse).splitlines()
    if len(lines) > _MAX_ROWS:
        raise refuse(expected=f"at most {_MAX_ROWS} rows", got=len(lines))
    rows = csv.reader(lines)
    values: dict[tuple[float, str], list[float]] = {}
    try:
        header = tuple(word.strip() for word in next(rows, []))
        if header != _HEADER:
            raise refuse(expected=f"the header {','.join(_HEADER)}", got=",".join(header)[:200])
        for row in rows:
            if not row:
                continue
            where = f"line {rows.line_num}"
            if len(row) != len(_HEADER):
                raise refuse(expected=f"{len(_HEADER)} values in {where}", got=len(row))
            numbers = [float(word) if word.strip() else np.nan for word in (row[0], *row[2:])]
            key = (numbers[0], row[1].strip())
            if not np.isfinite(numbers[0]):
                raise refuse(expected=f"a time in {where}", got=row[0])
            if key in values:
                raise refuse(expected="each point once at a time", got=f"'{key[1]}' at {row[0]} s again in {where}")
            values[key] = numbers[1:]
    except (ValueError, csv.Error) as error:
        raise refuse(expected=f"numbers in line {rows.line_num}", got=error) from None
    times, names = sorted({time for time, _ in values}), sorted({name for _, name in values})
    place = {time: k for k, time in enumerate(times)}
    points = {name: np.full((len(times), 3), np.nan) for name in names if name in POINTS}
    for (time, name), xyz in values.items():
        if name not in points:
            raise refuse(expected=f"points of {', '.join(POINTS)}", got=name)
        points[name][place[time]] = xyz
    return np.array(times), points


def _without_head_motion(points: Mapping[str, Float[np.ndarray, "T 3"]]) -> dict[str, Float[np.ndarray, "T 3"]]:
    incisors = points["upper_incisors"]
    centred = {name: place - incisors for name, place in points.items()}
    fixed = [name for name in HEAD_POINTS if name in points]
    if len(fixed) < 3 or not np.isfinite(incisors).all(1).any():
        return centred
    head = np.stack([centred[name] for name in fixed], 1)
    whole = np.isfinite(head).all((1, 2))
    if not whole.any():
        return centred
    reference = np.median(head[whole], axis=0)
    reference = reference - reference[0]  # the incisors are the origin
    measured = np.where(np.isfinite(head), head, 0.0)
    weights = (np.isfinite(head).all(2) & whole[:, None]).astype(np.float64)
    turn = align(measured, reference, weights)
    # About the incisors: they stay the origin whatever the other points' noise.
    return {name: np.einsum("tcd,td->tc", turn[:, :3, :3], place) for name, place in centred.items()}
