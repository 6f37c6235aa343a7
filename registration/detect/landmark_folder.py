"""Landmark files from disk in place of a detector: a folder of NAME.json, as captures have them in `landmarks/`."""

import hashlib
from collections.abc import Mapping
from dataclasses import replace
from functools import cached_property
from pathlib import Path

import numpy as np
from jaxtyping import Float

from registration.capture.landmark_files import ViewLandmarks, read_landmarks
from registration.capture.pixels import undistort_landmarks
from registration.detect.provider import Face
from registration.detect.views import ViewFaces
from registration.doctor import landmark_checks
from registration.errors import InputError
from registration.storage.hashing import hash_file
from registration.types import Capture, View

_SPREAD = 0.008  # relative to the face's size, where files state none: between a detector's and a person's
_MIN_SEEN = 4


class LandmarkFolder:
    """Landmarks of one scheme that another program or a person wrote, checked as detected ones are.

    Args:
        folder: of files NAME.json, or of subfolders of them.
        scheme: which of the files' schemes; "": the only one.
    """

    def __init__(self, folder: Path, scheme: str = "") -> None:
        self._folder, self._scheme = Path(folder), scheme

    @cached_property
    def _files(self) -> dict[str, Path]:
        """The files by the view's name."""
        files = sorted(self._folder.rglob("*.json")) if self._folder.is_dir() else []
        if not files:
            raise self._error("a folder with NAME.json for the views", "no such file", "choose the folder of the files")
        return {file.relative_to(self._folder).with_suffix("").as_posix(): file for file in files}

    @cached_property
    def _landmarks(self) -> Mapping[str, ViewLandmarks]:
        return {name: read_landmarks(file) for name, file in self._files.items()}

    @cached_property
    def scheme(self) -> str:
        """Name of the scheme. Raises InputError if files have several, or not this one, or of other lengths."""
        lengths: dict[str, set[int]] = {}
        for marks in self._landmarks.values():
            for name, rows in marks.points.items():
                lengths.setdefault(name, set()).add(len(rows))
        name = self._scheme or (next(iter(lengths)) if len(lengths) == 1 else "")
        if name not in lengths:
            got = f"schemes {', '.join(sorted(lengths)) or 'of no name'}"
            raise self._error("one scheme", got, f"name it: files:{self._folder}:SCHEME")
        if len(lengths[name]) > 1:
            got = f"{' and '.join(map(str, sorted(lengths[name])))} points"
            raise self._error(
                f"as many points of scheme {name} in every file", got, "write a point that is not seen as null"
            )
        return name

    @property
    def count(self) -> int:
        """How many landmarks the scheme has."""
        return next(len(marks.points[self.scheme]) for marks in self._landmarks.values() if self.scheme in marks.points)

    @property
    def version(self) -> str:
        """Digest of the files."""
        digests = [(name, hash_file(file)) for name, file in self._files.items()]
        return f"files {hashlib.sha256(repr((self.scheme, digests)).encode()).hexdigest()}"

    def check(self, capture: Capture) -> None:
        """Check that the files belong to a capture's views.

        Raises:
            InputError: a file is malformed or of no view, or its values are of another resolution or order.
        """
        names = {view.name for view in capture.views}
        if unknown := [name for name in self._files if name not in names]:
            got = f"{unknown[0]}.json" + (f" and {len(unknown) - 1} more of no view" if len(unknown) > 1 else "")
            raise self._error(f"files of the views, as {min(names)}.json", got, "rename or remove these files")
        given = tuple(self._given(view) for view in capture.views)
        named = replace(capture, views=given, root=self._folder.parent)
        landmark_checks.check_values(named)
        landmark_checks.check_coordinates(named)

    def faces(self, view: View) -> ViewFaces:
        """Return the face that a view's file describes, or none."""
        camera = replace(view.camera, distortion=())
        given = self._given(view)
        if self.scheme not in given.landmarks:
            return ViewFaces(view=view, camera=camera, faces=(), how="file")
        rows = undistort_landmarks(given, self.scheme)
        seen = rows[:, 2] > 0
        if seen.sum() < _MIN_SEEN:
            return ViewFaces(view=view, camera=camera, faces=(), how="file")
        points = np.where(seen[:, None], rows[:, :2], rows[seen, :2].mean(0))
        low, high = points.min(0), points.max(0)
        spread_px: Float[np.ndarray, L] = np.full(len(points), _SPREAD * max(float((high - low).max()), 1.0))
        if self.scheme in given.landmark_spread_px:
            spread_px = given.landmark_spread_px[self.scheme]
        face = Face(
            points=points,
            confidence=np.clip(rows[:, 2], 0, 1),
            spread_px=spread_px,
            presence=1.0,
            box=np.concatenate([low, high]),
        )
        return ViewFaces(view=view, camera=camera, faces=(face,), how="file")

    def _given(self, view: View) -> View:
        marks = self._landmarks.get(view.name)
        if marks is None or self.scheme not in marks.points:
            return replace(view, landmarks={}, landmark_spread_px={})
        spreads = {self.scheme: marks.spread_px[self.scheme]} if self.scheme in marks.spread_px else {}
        return replace(view, landmarks={self.scheme: marks.points[self.scheme]}, landmark_spread_px=spreads)

    def _error(self, expected: object, got: object, fix: str) -> InputError:
        return InputError("The landmark files cannot be used", where=self._folder, expected=expected, got=got, fix=fix)
