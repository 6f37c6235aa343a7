"""The landmarks of a video: one face followed from frame to frame, or given ones."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from registration.detect.provider import Face
from registration.detect.providers import load_provider
from registration.detect.views import landmark_cache
from registration.errors import InputError
from registration.footage.faces import CachedFaces, choose, nearest, observed
from registration.footage.given import landmarks_of_video
from registration.footage.observed import Footage, scheme_of
from registration.footage.options import FootageOptions
from registration.footage.searched import no_face
from registration.footage.video import Frame, Video
from registration.landmark_fit.observations import MIN_POINTS, Observations, ViewCamera
from registration.model.landmarks import LandmarkScheme
from registration.progress import Progress
from registration.storage.hashing import hash_file

_THOROUGH = 5  # frames before the first face that are also searched turned and in tiles
_KEPT = 12  # frames for the picture of a search without result
_LOST = 10  # frames without the face, after which the nearest one counts wherever it is


def read_sequence_footage(
    source: Path,
    video: Video,
    schemes: Mapping[str, LandmarkScheme],
    options: FootageOptions,
    out: Path,
    progress: Progress,
) -> Footage:
    """Read the landmarks of a video's frames; those of a detector are cached by the content of each frame.

    Args:
        source: the video file.
        video: its header.
        schemes: of the model.
        options: of the fit.
        out: the folder that will be written; if no face is found, a picture of the search is written beside it.
        progress: receives steps and messages.

    Raises:
        InputError: a frame cannot be used, no frame shows a face, or given landmarks are of another length.
    """
    digests = {"video": hash_file(source)}
    if options.landmarks is not None:
        scheme, points, sigma = landmarks_of_video(options.landmarks, schemes)
        frames = [(frame.number, frame.time_s) for frame in video.frames()]
        _check_count(points, frames, options.landmarks, source)
        numbers = np.array([number for number, _ in frames], np.int64)
        times = np.array([time for _, time in frames])
        points, sigma = points[numbers], sigma[numbers]
        digests["landmarks"] = hash_file(options.landmarks)
        notes: list[str] = []
    else:
        provider = load_provider(options.detector)
        scheme = scheme_of(schemes, provider.scheme, provider.count, f"detector {options.detector}")
        tracker = _Tracker(CachedFaces(provider, landmark_cache()), options.face)
        expected = video.expected
        for done, frame in enumerate(video.frames(), 1):
            tracker.add(frame)
            progress.update(done, max(expected, done), "detecting landmarks")
        if not tracker.seen:
            raise no_face(tracker.empty, source, out)
        found = [observed(face) for face in tracker.faces if face is not None]
        points, sigma = np.array([pair[0] for pair in found]), np.array([pair[1] for pair in found])
        numbers, times = np.array(tracker.numbers, np.int64)[tracker.seen], np.array(tracker.times)[tracker.seen]
        notes = tracker.notes
        digests["detector"] = provider.version
    usable = np.isfinite(points).all(-1).sum(-1) >= MIN_POINTS
    notes += _left_out(numbers[~usable], f"fewer than {MIN_POINTS} landmarks are seen")
    if not usable.any():
        raise InputError(
            "Too few landmarks are seen",
            where=source,
            expected=f"a frame with at least {MIN_POINTS} landmarks",
            got=f"{int(np.isfinite(points).all(-1).sum(-1).max(initial=0))} at most",
            fix="use a video that shows the face",
        )
    view = ViewCamera(width_px=video.width_px, height_px=video.height_px, focal_px=options.focal)
    return Footage(
        kind="video",
        source=source,
        subject=source.stem,
        expression="sequence",
        observations=Observations(
            scheme=scheme, views=(view,), points_px=points[usable][:, None], sigma_px=sigma[usable][:, None]
        ),
        sights=(),
        numbers=numbers[usable],
        times_s=times[usable],
        detected=options.landmarks is None,
        focal_source="estimated, without a hint" if options.focal is None else "given",
        notes=tuple(notes),
        digests=digests,
    )


@dataclass
class _Tracker:
    """Follows one face."""

    search: CachedFaces
    number: int | None
    faces: list[Face | None] = field(default_factory=list)
    numbers: list[int] = field(default_factory=list)
    times: list[float] = field(default_factory=list)
    empty: list[tuple[str, np.ndarray]] = field(default_factory=list)
    lost: int = 0
    _before: Face | None = None
    _note: str = ""

    @property
    def seen(self) -> list[int]:
        """Positions of the frames with the face."""
        return [k for k, face in enumerate(self.faces) if face is not None]

    @property
    def notes(self) -> list[str]:
        missing = [number for number, face in zip(self.numbers, self.faces, strict=True) if face is None]
        return [*([self._note] if self._note else []), *_left_out(np.array(missing), "the face is not found")]

    def add(self, frame: Frame) -> None:
        self.numbers.append(frame.number)
        self.times.append(frame.time_s)
        face = self._first(frame) if self._before is None else self._next(frame, self._before)
        self.faces.append(face)
        self.lost = 0 if face is not None else self.lost + 1
        self._before = face or self._before

    def _first(self, frame: Frame) -> Face | None:
        found = self.search.search(frame.pixels, thorough=len(self.faces) < _THOROUGH).faces
        if not found:
            if len(self.empty) < _KEPT:
                self.empty.append((f"frame {frame.number}", frame.pixels))
            return None
        face, self._note = choose(found, self.number, f"frame {frame.number}")
        self.empty.clear()
        return face

    def _next(self, frame: Frame, before: Face) -> Face | None:
        face = self.search.follow(frame.pixels, before)
        if face is None and self.lost >= _LOST:
            found = self.search.search(frame.pixels, thorough=False).faces
            face = nearest(found, before, anywhere=True)
        return face


def _left_out(numbers: np.ndarray, why: str) -> list[str]:
    if not len(numbers):
        return []
    shown = ", ".join(map(str, numbers[:8].tolist())) + (" ..." if len(numbers) > 8 else "")
    return [f"left out, because {why}: {len(numbers)} frames ({shown})"]


def _check_count(points: np.ndarray, frames: list[tuple[int, float]], given: Path, source: Path) -> None:
    last = frames[-1][0] if frames else -1
    if not frames or last >= len(points):
        raise InputError(
            "There are landmarks of fewer frames than the video has",
            where=given,
            expected=f"a row for each frame of {source}, {last + 1} at least",
            got=f"{len(points)} rows",
            fix="write NaN for frames without landmarks, or choose frames with --start and --end",
        )
