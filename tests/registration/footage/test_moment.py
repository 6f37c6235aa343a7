"""One image, several images, and faces in them, fitted and written as a registration folder."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

import registration.footage.moment as moment
from registration.errors import InputError
from registration.export.options import ExportOptions
from registration.footage.fit import fit_footage
from registration.footage.moment import read_moment
from registration.footage.observed import Footage
from registration.footage.options import FootageOptions
from registration.footage.solve import read_identity, solver_options
from registration.landmark_fit.fit import fit_landmarks
from registration.progress import NullProgress
from registration.storage.registration_folder import load_registration, read_manifest
from tests.registration.footage import known
from workflows.cli.__main__ import main
from workflows.records.export_source import read_source


class Messages(NullProgress):
    def __init__(self) -> None:
        self.texts: list[str] = []

    def message(self, text: str) -> None:
        self.texts.append(text)


@pytest.fixture(scope="module")
def image(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An image with its landmarks beside it."""
    folder = tmp_path_factory.mktemp("image")
    points = known.landmarks(known.camera(), known.parameters())
    known.write_json(folder / "face.json", points)
    return known.write_image(folder / "face.png", known.picture(points))


@pytest.fixture(scope="module")
def fitted(image: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("fitted") / "out"
    options = FootageOptions(landmarks=image.with_suffix(".json"), focal=known.FOCAL)
    outcome = fit_footage(image, known.MODEL, out, options)
    assert outcome.status == "converged", outcome.reason
    return out


def test_an_image_becomes_a_registration(fitted: Path) -> None:
    result = load_registration(fitted)
    assert result.status == "converged" and not result.offsets.any()
    points = known.landmarks(known.camera(), known.parameters())
    (file,) = (fitted / "sparse").glob("images.txt")
    assert "face.png" in file.read_text()
    view = known.camera()
    K = view.intrinsics
    xy = result.landmarks["68"] @ K.T
    assert np.abs(xy[:, :2] / xy[:, 2:] - points).max() < 0.5  # the camera's frame is the world
    assert 0 <= result.confidence.min() and 0.01 < result.confidence.max() < 1
    names = {path.name for path in fitted.iterdir()}
    assert {"overlay.jpg", "uncertainty.npz", "uncertainty.png", "report.html", "sparse"} <= names
    with np.load(fitted / "uncertainty.npz") as arrays:
        count = len(result.identity)
        assert arrays["vertex_sigma_mm"].shape == (len(result.vertices), 3)
        assert arrays["identity_covariance"].shape == (count, count)
        assert (arrays["vertex_sigma_mm"] >= 0).all() and arrays["vertex_sigma_mm"].max() > 0
    manifest = read_manifest(fitted)
    assert manifest.figures["landmark_fit"]["focal_px"] == {"face": known.FOCAL}
    assert any("depth of the nose" in note for note in manifest.figures["notes"])
    assert "depth of the nose" in (fitted / "report.html").read_text()


def test_what_reads_registrations_reads_it(fitted: Path) -> None:
    assert len(read_source(fitted, known.MODEL, ExportOptions()).head.vertices) == len(
        load_registration(fitted).vertices
    )


def test_the_same_inputs_are_not_fitted_again(image: Path, fitted: Path) -> None:
    before = (fitted / "manifest.json").stat().st_mtime_ns
    messages = Messages()
    options = FootageOptions(landmarks=image.with_suffix(".json"), focal=known.FOCAL)
    fit_footage(image, known.MODEL, fitted, options, progress=messages)
    assert (fitted / "manifest.json").stat().st_mtime_ns == before
    assert any("already holds" in text for text in messages.texts)


def test_its_identity_is_taken_as_known(fitted: Path, tmp_path: Path) -> None:
    identity = read_identity(fitted, known.DATA)
    assert identity is not None and identity.offsets is None
    points = known.landmarks(known.camera(), known.parameters(turn=0.3, shift=0.02))
    file = known.write_image(tmp_path / "other.png", known.picture(points))
    options = FootageOptions(landmarks=known.write_json(tmp_path / "other.json", points), focal=known.FOCAL)
    footage = read(file, options)
    fit = fit_landmarks(footage.observations, known.DATA, solver_options(footage, options, identity))
    assert np.array_equal(fit.identity, load_registration(fitted).identity.astype(np.float64))
    with pytest.raises(InputError, match="There is no identity"):
        read_identity(tmp_path, known.DATA)


def read(source: Path, options: FootageOptions) -> Footage:
    schemes = {"68": known.SCHEME}
    out = source.with_name("out")
    return read_moment("views" if source.is_dir() else "image", source, schemes, options, out, NullProgress())


def test_views_without_cameras_get_cameras(tmp_path: Path) -> None:
    head = known.parameters(1)
    for name, yaw in (("left", -0.4), ("front", 0.0), ("right", 0.4)):
        points = known.landmarks(known.camera(yaw), head)
        known.write_image(tmp_path / "views" / f"{name}.png", known.picture(points))
        known.write_json(tmp_path / "marks" / f"{name}.json", points)
    known.write_image(tmp_path / "views" / "unseen.png", known.picture(points))
    options = FootageOptions(landmarks=tmp_path / "marks")
    footage = read(tmp_path / "views", options)
    assert [sight.name for sight in footage.sights] == ["front", "left", "right"]
    assert footage.notes == ("unseen: no landmarks; left out",)
    fit = fit_landmarks(footage.observations, known.DATA, solver_options(footage, options, None))
    focal = {float(camera.intrinsics[0, 0]) for camera in fit.cameras}
    assert len(focal) == 1 and fit.rms_px[0] < 0.3
    looks = [camera.T_cam_world[2, :3] for camera in fit.cameras]
    assert np.degrees(np.arccos(looks[1] @ looks[2])) == pytest.approx(np.degrees(0.8), abs=3)


def detector(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, faces: dict[bytes, list[np.ndarray]]) -> known.KnownFaces:
    provider = known.KnownFaces(faces)
    monkeypatch.setattr(moment, "load_provider", lambda name: provider)
    monkeypatch.setattr(moment, "landmark_cache", lambda: tmp_path / "cache")
    return provider


def test_the_largest_of_several_faces_is_chosen_and_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    near, far = (known.landmarks(known.camera(), known.parameters(2)) * scale for scale in (0.9, 0.3))
    pixels = known.picture(near)
    file = known.write_image(tmp_path / "two.png", pixels)
    provider = detector(monkeypatch, tmp_path, {pixels.tobytes(): [far, near]})
    footage = read(file, FootageOptions())
    assert "2 faces; the largest is fitted" in footage.notes[0] and footage.detected
    assert np.allclose(footage.observations.points_px[0, 0], near)
    assert provider.calls == 1
    footage = read(file, FootageOptions(face=2))
    assert np.allclose(footage.observations.points_px[0, 0], far) and "number 2 by size" in footage.notes[0]
    assert provider.calls == 1  # cached by the content of the pixels
    with pytest.raises(InputError, match="There is no such face"):
        read(file, FootageOptions(face=3))


def test_no_face_is_shown_in_a_picture(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file = known.write_image(tmp_path / "empty.png", np.zeros((50, 60, 3), np.uint8))
    detector(monkeypatch, tmp_path, {})
    with pytest.raises(InputError, match="No face was found") as error:
        fit_footage(file, known.MODEL, tmp_path / "out")
    assert not (tmp_path / "out").exists()
    picture = tmp_path / "out.searched.png"
    assert str(picture) in error.value.got and cv2.imread(str(picture)) is not None


def test_too_few_points_and_mirrored_ones_are_refused(image: Path, tmp_path: Path) -> None:
    points = known.landmarks(known.camera(), known.parameters())
    rows = [[*point, 1.0] if k < 19 else None for k, point in enumerate(points.tolist())]
    (tmp_path / "few.json").write_text(json.dumps({"68": rows}))
    with pytest.raises(InputError, match="Too few landmarks"):
        fit_footage(image, known.MODEL, tmp_path / "out", FootageOptions(landmarks=tmp_path / "few.json"))
    for yaw in (0.0, 0.5):
        mirrored = known.landmarks(known.camera(yaw), known.parameters()) * [-1, 1] + [known.SIZE[0], 0]
        given = known.write_json(tmp_path / "mirrored.json", mirrored)
        with pytest.raises(InputError, match="mirrored"):
            fit_footage(image, known.MODEL, tmp_path / "out", FootageOptions(landmarks=given))
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("source", "expected"),
    [("missing", "no such file or folder"), ("empty", "an empty folder"), ("text.txt", "a file *.txt")],
)
def test_inputs_that_are_none(tmp_path: Path, source: str, expected: str, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "empty").mkdir()
    (tmp_path / "text.txt").write_text("text")
    code = main(["fit", str(tmp_path / source), "--model", str(known.MODEL), "--out", str(tmp_path / "out")])
    assert code == 2 and expected in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_a_folder_with_other_things_is_not_replaced(image: Path, tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(InputError, match="output folder"):
        fit_footage(image, known.MODEL, tmp_path, FootageOptions(landmarks=image.with_suffix(".json")))


@pytest.mark.parametrize(
    "options",
    [{"focal": float("nan")}, {"focal": -3.0}, {"face": 0}, {"every": 0}, {"frames": "1,x"}, {"start": 4, "end": 4}],
)
def test_options_out_of_range(options: dict) -> None:
    with pytest.raises(InputError, match="out of range"):
        FootageOptions(**options)


def test_a_focal_length_that_is_no_number(image: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        main(["fit", str(image), "--model", str(known.MODEL), "--out", "out", "--focal", "long"])
    assert stop.value.code == 2 and "long" in capsys.readouterr().err


@pytest.mark.parametrize("changed", [{"focal": 900.0}, {"principal_point": True}, {"distortion": True}])
def test_options_of_unknown_cameras_are_refused_for_captures(tmp_path, changed):
    capture = tmp_path / "capture"
    capture.mkdir()
    (capture / "capture.toml").write_text("", "utf-8")
    with pytest.raises(InputError, match="unknown cameras only"):
        fit_footage(capture, tmp_path / "model.npz", tmp_path / "out", FootageOptions(**changed))
