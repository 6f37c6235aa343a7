"""A video is followed from frame to frame, fitted and written; an interruption loses no detections."""

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

import registration.footage.sequence as sequence
from registration.detect.provider import Face
from registration.errors import InputError
from registration.footage.faces import CachedFaces
from registration.footage.fit import fit_footage
from registration.footage.options import FootageOptions
from registration.footage.sequence import read_sequence_footage
from registration.footage.sequence_file import read_sequence
from registration.footage.solve import read_identity, solver_options
from registration.footage.video import open_video
from registration.footage.windows import fit_long, windows
from registration.landmark_fit.fit import fit_landmarks
from registration.model.gnm import GNM
from registration.progress import NullProgress
from tests.registration.footage import known

FRAMES, STEP, PATCH = 12, 18, 16  # of brightness from frame to frame, px of the corner that shows it


def points_of(frame: int) -> np.ndarray:
    return known.landmarks(known.camera(), known.parameters(3, turn=0.03 * frame, shift=0.002 * frame))


@pytest.fixture(scope="module")
def video(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A video in whose corner the brightness says which frame it is."""
    file = tmp_path_factory.mktemp("video") / "talk.avi"
    writer = cv2.VideoWriter(str(file), cv2.VideoWriter.fourcc(*"MJPG"), 20, known.SIZE)
    for number in range(FRAMES):
        frame = known.picture(points_of(number))
        frame[: 2 * PATCH, : 2 * PATCH] = 20 + STEP * number
        writer.write(frame[..., ::-1].copy())
    writer.release()
    return file


class FrameFaces:
    """A provider that reads the frame's number in the corner. It follows faces, and may be told to stop or to miss."""

    scheme, count, version = "68", 68, "by the frame"

    def __init__(self, stop_after: int = 10**9, missing: Sequence[int] = (), second: bool = False) -> None:
        self.detected, self.followed, self.second = 0, 0, second
        self._left, self._missing = stop_after, missing

    def _faces(self, image: np.ndarray) -> list[Face]:
        if self._left == 0:
            raise KeyboardInterrupt
        self._left -= 1
        number = round((float(image[:PATCH, :PATCH].mean()) - 20) / STEP)
        if number in self._missing:
            return []
        face = known.face_of(points_of(number))
        other = known.face_of(0.4 * points_of(number) + 10.0)
        return [other, face] if self.second else [face]

    def detect(self, image: np.ndarray) -> Sequence[Face]:
        self.detected += 1
        return self._faces(image)

    def follow(self, image: np.ndarray, before: Face) -> Face | None:
        self.followed += 1
        faces = self._faces(image)
        return min(faces, key=lambda face: float(np.abs(face.points - before.points).max()), default=None)


@pytest.fixture()
def use(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    def with_provider(provider: FrameFaces) -> FrameFaces:
        monkeypatch.setattr(sequence, "load_provider", lambda name: provider)
        monkeypatch.setattr(sequence, "landmark_cache", lambda: tmp_path / "cache")
        return provider

    return with_provider


def read(file: Path, options: FootageOptions = FootageOptions(), out: Path = Path("out")):  # noqa: B008
    schemes = {"68": known.SCHEME}
    return read_sequence_footage(file, open_video(file, options), schemes, options, out, NullProgress())


def test_a_video_becomes_a_folder(video: Path, tmp_path: Path, use) -> None:
    use(FrameFaces())
    out = tmp_path / "out"
    options = FootageOptions(focal=known.FOCAL, meshes="obj", frames="0,5")
    outcome = fit_footage(video, known.MODEL, out, options)
    assert outcome.status == "converged", outcome.reason
    arrays = read_sequence(out / "fit.npz")
    assert arrays["frames"].tolist() == list(range(FRAMES))
    assert arrays["times_s"] == pytest.approx(np.arange(FRAMES) / 20, abs=1e-3)
    assert arrays["expression"].shape == (FRAMES, len(known.DATA.expression_basis))
    assert np.nanmax(np.abs(arrays["residual_px"])) < 1.5
    assert arrays["camera_intrinsics"][0, 0, 0] == pytest.approx(known.FOCAL)
    assert json.loads(str(arrays["config"]))["input"] == "video"
    assert {path.name for path in (out / "meshes").glob("*.obj")} == {"000000.obj", "000005.obj"}
    manifest = json.loads((out / "manifest.json").read_text())
    assert manifest["kind"] == "gnm-landmark-fit" and manifest["status"] == "converged"
    page = (out / "index.html").read_text()
    assert 'src="overlay.webm"' in page and "Opening of the mouth" in page and "depth of the nose" in page
    film = cv2.VideoCapture(str(out / "overlay.webm"))
    frames = [film.read()[1] for _ in range(FRAMES)]
    assert not film.read()[0] and frames[0].shape[1::-1] == known.SIZE
    with torch.no_grad():
        vertices = GNM(known.DATA, dtype=torch.float64)(known.parameters(3)).numpy()
    x, y = np.round(known.camera().project(vertices)[0].mean(0)).astype(int)
    assert frames[0][y - 9 : y + 9, x - 9 : x + 9].std() > 1 or frames[0][y, x].mean() > 120  # the mesh is drawn
    stamp = (out / "fit.npz").stat().st_mtime_ns
    fit_footage(video, known.MODEL, out, options)
    assert (out / "fit.npz").stat().st_mtime_ns == stamp
    identity = read_identity(out, known.DATA)
    assert identity is not None and np.allclose(identity.identity, arrays["identity"])


def test_a_face_is_followed_and_lost_frames_are_left_out(video: Path, use) -> None:
    provider = use(FrameFaces(missing=(0, 4), second=True))
    footage = read(video)
    assert footage.numbers.tolist() == [k for k in range(FRAMES) if k not in (0, 4)]
    assert np.allclose(footage.observations.points_px[0, 0], points_of(1))
    assert np.allclose(footage.observations.points_px[-1, 0], points_of(FRAMES - 1))
    assert any("2 faces; the largest" in note for note in footage.notes)
    assert any("2 frames (0, 4)" in note for note in footage.notes)
    assert provider.followed == FRAMES - 2
    small = read(video, FootageOptions(face=2))
    assert np.allclose(small.observations.points_px[-1, 0], 0.4 * points_of(FRAMES - 1) + 10)


def test_an_interrupted_run_continues_from_its_detections(video: Path, tmp_path: Path, use) -> None:
    use(FrameFaces(stop_after=7))
    with pytest.raises(KeyboardInterrupt):
        fit_footage(video, known.MODEL, tmp_path / "out")
    assert not (tmp_path / "out").exists()
    provider = use(FrameFaces())
    assert len(read(video).numbers) == FRAMES
    assert provider.detected + provider.followed == FRAMES - 7


def test_some_frames(video: Path, use) -> None:
    use(FrameFaces())
    assert read(video, FootageOptions(start=2, end=9, every=3)).numbers.tolist() == [2, 5, 8]
    assert open_video(video, FootageOptions(start=2, end=9, every=3)).expected == 3
    with pytest.raises(InputError, match="ends before --start"):
        open_video(video, FootageOptions(start=FRAMES))
    with pytest.raises(InputError, match="no such frame"):
        fit_footage(video, known.MODEL, Path("out"), FootageOptions(meshes="glb", frames="3,99"))


def test_given_landmarks_of_a_video(video: Path, tmp_path: Path) -> None:
    points = np.array([points_of(k) for k in range(FRAMES)])
    points[3] = np.nan
    given = tmp_path / "points.npz"
    np.savez(given, points=points)
    footage = read(video, FootageOptions(landmarks=given))
    assert footage.numbers.tolist() == [k for k in range(FRAMES) if k != 3] and not footage.detected
    assert footage.observations.sigma_px.min() > 0.5  # a share of the face's size
    np.savez(given, points=points[: FRAMES - 1])
    with pytest.raises(InputError, match="fewer frames"):
        read(video, FootageOptions(landmarks=given))
    np.savez(given, points=points[:, :5])
    with pytest.raises(InputError, match="no map"):
        read(video, FootageOptions(landmarks=given))
    np.savez(given, points=np.full_like(points, np.nan))
    with pytest.raises(InputError, match="Too few landmarks"):
        read(video, FootageOptions(landmarks=given))


def test_no_face_in_a_video(video: Path, tmp_path: Path, use) -> None:
    use(FrameFaces(missing=range(FRAMES)))
    with pytest.raises(InputError, match="No face"):
        read(video, out=tmp_path / "out")
    assert (tmp_path / "out.searched.png").is_file()


def test_files_that_are_no_video(tmp_path: Path) -> None:
    (tmp_path / "a.mp4").write_bytes(b"no video" * 100)
    with pytest.raises(InputError, match="video cannot be"):
        open_video(tmp_path / "a.mp4", FootageOptions())


def test_frames_of_different_sizes_are_refused(video: Path) -> None:
    opened = open_video(video, FootageOptions())
    with pytest.raises(InputError, match="different sizes"):
        next(iter(replace(opened, width_px=opened.width_px + 2).frames()))


def test_a_folder_of_another_kind_is_not_replaced(video: Path, tmp_path: Path) -> None:
    (tmp_path / "mine.txt").write_text("mine")
    with pytest.raises(InputError, match="output folder"):
        fit_footage(video, known.MODEL, tmp_path)


def test_options_of_videos_are_refused_for_images(tmp_path: Path) -> None:
    file = known.write_image(tmp_path / "a.png", known.picture(points_of(0)))
    with pytest.raises(InputError, match="for videos only"):
        fit_footage(file, known.MODEL, tmp_path / "out", FootageOptions(every=2))


@pytest.mark.parametrize("count", [1, 47, 300, 601])
def test_windows_keep_each_frame_once(count: int) -> None:
    kept: list[int] = []
    for span, own in windows(count, 40, 8):
        kept += list(range(count))[span][own]
    assert kept == list(range(count))


def test_a_long_sequence_is_as_a_short_one(video: Path, use) -> None:
    use(FrameFaces())
    options = FootageOptions(focal=known.FOCAL)
    footage = read(video, options)
    settings = solver_options(footage, options, None)
    assert settings.temporal is not None
    settings = replace(settings, identity=known.parameters(3).identity.numpy())  # else one view leaves the size open
    whole = fit_landmarks(footage.observations, known.DATA, settings)
    steps: list[tuple[int, int]] = []
    parts = fit_long(footage.observations, known.DATA, settings, longest=8, report=lambda *done: steps.append(done))
    assert steps[-1][0] == steps[-1][1] >= 2
    distance = np.linalg.norm(
        parts.vertices(known.DATA, slice(None)) - whole.vertices(known.DATA, slice(None)), axis=-1
    )
    assert 1e3 * np.median(distance) < 2.0
    assert parts.residual_px.shape == whole.residual_px.shape


def test_providers_that_cannot_follow_are_asked_again() -> None:
    points = points_of(0)
    pixels = known.picture(points)
    provider = known.KnownFaces({pixels.tobytes(): [points, 0.3 * points]})
    found = CachedFaces(provider, None).follow(pixels, known.face_of(points + 2.0))
    assert found is not None and np.array_equal(found.points, points)
    assert CachedFaces(provider, None).follow(pixels, known.face_of(points + 900.0)) is None
