"""Detected landmarks as files: landmarks/NAME.json beside other schemes, and what was seen in words."""

import json
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from registration.capture.landmark_files import read_landmarks
from registration.detect.capture_landmarks import CaptureLandmarks, ViewDetection
from registration.errors import InputError
from registration.storage.files import atomic_write_text, write_json
from registration.storage.jsonable import to_jsonable
from registration.storage.reading import read_json
from registration.types import Capture, View

DETECTIONS = "detections.json"
SHEET = "detections.png"
KIND = "landmark detections"
_DECIMALS = 3  # of pixels


def check_scheme_is_new(capture: Capture, scheme: str) -> None:
    """Refuse to replace landmarks that a capture has.

    Raises:
        InputError: one of its landmark files has the scheme.
    """
    for view in capture.views:
        if scheme in view.landmarks:
            raise InputError(
                f"The capture has landmarks of scheme {scheme} already",
                where=landmark_file(capture.root, view),
                expected="no landmarks of this scheme, or --replace",
                got=f"{len(view.landmarks[scheme])} landmarks of {view.name}",
                fix="add --replace to replace them in all views, or write elsewhere with --out",
            )


def landmark_file(root: Path, view: View) -> Path:
    """Return the path of a view's landmark file in a folder, under the name that it has there or should have."""
    folder = root / "landmarks"
    longer = folder / f"{view.name}{view.image.suffix}.json"
    return longer if longer.is_file() else folder / f"{view.name}.json"


def write_landmark_files(capture: Capture, landmarks: CaptureLandmarks, root: Path) -> list[Path]:
    """Write the landmarks of the views with a used face, each file in one rename.

    Other schemes of the capture's files are kept as they are. Views without a used face get no file, and lose the
    scheme where their file has it.

    Args:
        capture: the capture.
        landmarks: detected in it.
        root: the capture's folder, or another that gets a folder `landmarks`.

    Returns:
        The files that were written.

    Raises:
        InputError: a landmark file of the capture is damaged.
    """
    found = {detection.name: detection for detection in landmarks.views}
    contents = {}
    for view in capture.views:
        before = _content(landmark_file(capture.root, view))
        after = {name: rows for name, rows in before.items() if name != landmarks.scheme}
        if len(found[view.name].landmarks):
            after[landmarks.scheme] = _rows(found[view.name])
        if after != before or (after and root != capture.root):
            contents[landmark_file(root, view)] = after
    for file, content in contents.items():
        file.parent.mkdir(parents=True, exist_ok=True)
        atomic_write_text(file, json.dumps(content) + "\n")
    return list(contents)


def write_detections(landmarks: CaptureLandmarks, file: Path) -> None:
    """Write what was detected as JSON: outcome, warnings, hints, points in space, and what each view shows."""
    write_json(file, {"kind": KIND, "version": 1, **detections(landmarks)})


def detections(landmarks: CaptureLandmarks) -> dict[str, Any]:
    """Return what `write_detections` writes, as values of JSON."""
    values: dict[str, Any] = to_jsonable(
        {
            "scheme": landmarks.scheme,
            "provider": landmarks.version,
            "outcome": landmarks.outcome,
            "reason": landmarks.reason,
            "warnings": landmarks.warnings,
            "hints": {name: round(score, 4) for name, score in landmarks.hints.items()},
            "views": {detection.name: _summary(detection) for detection in landmarks.views},
            "points_m": np.round(landmarks.points, 6),
            "points_views": landmarks.used,
            "points_residual_px": np.round(landmarks.point_residual_px, _DECIMALS),
        }
    )
    return values


def _summary(detection: ViewDetection) -> dict[str, Any]:
    summary: dict[str, Any] = {"state": detection.state, "note": detection.note, "faces": len(detection.faces)}
    if detection.chosen is not None:
        known = detection.residual_px[np.isfinite(detection.residual_px)]
        summary |= {
            "presence": round(detection.faces[detection.chosen].presence, 4),
            "residual_px": round(float(np.median(known)), _DECIMALS) if len(known) else None,
            "spread_px": round(float(np.median(detection.spread_px)), _DECIMALS),
            "outliers": list(detection.outliers),
        }
    return summary


def _rows(detection: ViewDetection) -> list[list[float]]:
    rows = np.column_stack([detection.landmarks, np.maximum(detection.spread_px, 10.0**-_DECIMALS)])
    result: list[list[float]] = np.round(rows, _DECIMALS).tolist()
    return result


def _content(file: Path) -> Mapping[str, Any]:
    """The schemes of a landmark file as they are written there; none if there is no file."""
    if not file.is_file():
        return {}
    read_landmarks(file)  # refuses what is malformed
    refuse = partial(InputError.unreadable, "landmark file", where=file, fix="correct or remove it")
    content: dict[str, Any] = read_json(file, refuse, finite=False)
    return content
