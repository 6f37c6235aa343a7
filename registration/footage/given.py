"""Landmarks that another program or a person wrote, in place of detected ones."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float

from registration.capture.landmark_files import ViewLandmarks, read_landmarks
from registration.errors import InputError
from registration.footage.observed import scheme_of
from registration.model.landmarks import LandmarkScheme
from registration.storage.npz import NpzSchema

_SPREAD = 0.008  # relative to the face's size, where files state none: between a detector's and a person's
_VIDEO = NpzSchema(
    title="file of a video's landmarks",
    fix="write points as frames x landmarks x 2 or 3 (x px, y px, confidence), NaN where one is not seen",
    fields={"points": ("float", "F L D")},
    families={"sigma": ("float", "F L"), "scheme": ("text", "")},
    finite=False,
)

Points = tuple[Float[np.ndarray, "L 2"], Float[np.ndarray, "L"]]  # NaN: not seen; standard deviations, px


def landmarks_of_views(
    path: Path, names: Sequence[str], schemes: Mapping[str, LandmarkScheme]
) -> tuple[LandmarkScheme, list[Points]]:
    """Read the landmarks of some images: NAME.json for each of them, or one file for a single image.

    Args:
        path: a file, or a folder of files.
        names: of the images, without suffix.
        schemes: of the model. Of several in the files, the one of most landmarks is taken.

    Returns:
        The scheme, and the landmarks of each image; all NaN for one without a file.

    Raises:
        InputError: nothing of the model's schemes is there, or a file is malformed.
    """
    files = _files(path, names)
    read = {name: read_landmarks(file) for name, file in files.items()}
    counts = {name: len(rows) for marks in read.values() for name, rows in marks.points.items()}
    known = [name for name in counts if name in schemes]
    if not known:
        scheme_of(schemes, ", ".join(counts) or "no scheme", 0, path)
    name = max(known, key=lambda known: counts[known])
    for image, marks in read.items():
        if name in marks.points:
            scheme_of(schemes, name, len(marks.points[name]), files[image])
    empty = (np.full((len(schemes[name].indices), 2), np.nan), np.ones(len(schemes[name].indices)))
    found = [_points(read[view], name) if view in read and name in read[view].points else empty for view in names]
    return schemes[name], found


def _files(path: Path, names: Sequence[str]) -> dict[str, Path]:
    if path.is_file() and len(names) == 1:
        return {names[0]: path}
    found = {name: path / f"{name}.json" for name in names if (path / f"{name}.json").is_file()}
    if not found:
        raise InputError(
            "The landmark files are missing",
            where=path,
            expected=f"a folder with {names[0]}.json"
            + (", or a file" if len(names) == 1 else " and those of the others"),
            got="a file" if path.is_file() else "no such files" if path.is_dir() else "no such folder",
            fix="name the files as the images",
        )
    return found


def _points(marks: ViewLandmarks, scheme: str) -> Points:
    rows = marks.points[scheme]
    points = np.where((rows[:, 2] > 0)[:, None], rows[:, :2], np.nan)
    return points, marks.spread_px.get(scheme, _default_sigma(points))


def _default_sigma(points: Float[np.ndarray, "*F L 2"]) -> Float[np.ndarray, "*F L"]:
    """A share of the size of each face, at least a tenth of a pixel."""
    with np.errstate(invalid="ignore"):
        seen = np.where(np.isfinite(points), points, np.nan)
        low = np.where(np.isnan(seen), np.inf, seen).min(-2)
        high = np.where(np.isnan(seen), -np.inf, seen).max(-2)
        size = np.nan_to_num((high - low).max(-1), neginf=0.0)
    return np.broadcast_to(np.maximum(_SPREAD * size, 0.1)[..., None], points.shape[:-1]).copy()


def landmarks_of_video(
    path: Path, schemes: Mapping[str, LandmarkScheme]
) -> tuple[LandmarkScheme, Float[np.ndarray, "F L 2"], Float[np.ndarray, "F L"]]:
    """Read the landmarks of all frames of a video from an NPZ file.

    It holds `points`, frames x landmarks x 2, or x 3 with a confidence; optionally `sigma_px`, frames x landmarks, and
    the name of the `scheme`, without which the number of landmarks tells it.

    Returns:
        The scheme, points, NaN where one is not seen, and standard deviations, px.

    Raises:
        InputError: the file is malformed, or its landmarks are none of the model's.
    """
    if path.is_dir() or not path.is_file():
        raise InputError(
            "The landmark file is missing",
            where=path,
            expected="an NPZ file with points, frames x landmarks x 2 or 3",
            got="a folder" if path.is_dir() else "no such file",
            fix="give the landmarks of all frames of the video in one file",
        )
    arrays = _VIDEO.read(path)
    points = arrays["points"].astype(np.float64)
    count, width = points.shape[1:]
    fitting = [name for name, scheme in schemes.items() if len(scheme.indices) == count]
    name = str(arrays["scheme"]) if "scheme" in arrays else (fitting or [f"of {count} points"])[0]
    scheme = scheme_of(schemes, name, count, path)
    if width not in (2, 3):
        raise InputError(
            "The landmarks have no coordinates",
            where=f"points in {path}",
            expected="2 numbers a landmark, or 3 with a confidence",
            got=width,
            fix="write x px, y px, confidence",
        )
    if width == 3:
        points = np.where((points[..., 2] > 0)[..., None], points[..., :2], np.nan)
    else:
        points = np.where(np.isfinite(points).all(-1, keepdims=True), points, np.nan)
    sigma = arrays["sigma_px"].astype(np.float64) if "sigma_px" in arrays else _default_sigma(points)
    return scheme, points, sigma
