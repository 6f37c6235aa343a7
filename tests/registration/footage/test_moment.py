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
from registration.footage.options import FootageOptions
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


def test_its_identity_is_taken_as_known(image: Path, fitted: Path, tmp_path: Path) -> None:
    points = known.landmarks(known.camera(), known.parameters(turn=0.3, shift=0.02))
    other = known.write_image(tmp_path / "other.png", known.picture(points))
    given = known.write_json(tmp_path / "other.json", points)
    options = FootageOptions(landmarks=given, focal=known.FOCAL, identity_from=fitted)
    fit_footage(other, known.MODEL, tmp_path / "out", options)
    assert np.array_equal(load_registration(tmp_path / "out").identity, load_registration(fitted).identity)
    with pytest.raises(InputError, match="There is no identity"):
        fit_footage(other, known.MODEL, tmp_path / "b", FootageOptions(landmarks=given, identity_from=tmp_path))


def test_views_without_cameras_get_cameras(tmp_path: Path) -> None:
    head = known.parameters(1)
    for name, yaw in (("left", -0.4), ("front", 0.0), ("right", 0.4)):
        points = known.landmarks(known.camera(yaw), head)
        known.write_image(tmp_path / "views" / f"{name}.png", known.picture(points))
        known.write_json(tmp_path / "marks" / f"{name}.json", points)
    fit_footage(tmp_path / "views", known.MODEL, tmp_path / "out", FootageOptions(landmarks=tmp_path / "marks"))
    figures = read_manifest(tmp_path / "out").figures
    assert len(figures["landmark_fit"]["focal_px"]) == 3 and len(set(figures["landmark_fit"]["focal_px"].values())) == 1
    assert figures["landmark_fit"]["rms_px"] < 0.3


def detector(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, faces: dict[bytes, list[np.ndarray]]) -> known.KnownFaces:
    provider = known.KnownFaces(faces)
    monkeypatch.setattr(moment, "load_provider", lambda name: provider)
    monkeypatch.setattr(moment, "landmark_cache", lambda: tmp_path / "cache")
    return provider


def test_the_largest_of_several_faces_is_fitted_and_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    near, far = (known.landmarks(known.camera(), known.parameters(2)) * scale for scale in (0.9, 0.3))
    pixels = known.picture(near)
    file = known.write_image(tmp_path / "two.png", pixels)
    provider = detector(monkeypatch, tmp_path, {pixels.tobytes(): [far, near]})
    messages = Messages()
    fit_footage(file, known.MODEL, tmp_path / "out", progress=messages)
    assert any("2 faces; the largest is fitted" in text for text in messages.texts)
    first = load_registration(tmp_path / "out")
    calls = provider.calls
    fit_footage(file, known.MODEL, tmp_path / "small", FootageOptions(face=2))
    assert provider.calls == calls  # cached by the content of the pixels
    assert load_registration(tmp_path / "small").translation[2] > 2 * first.translation[2]
    with pytest.raises(InputError, match="There is no such face"):
        fit_footage(file, known.MODEL, tmp_path / "none", FootageOptions(face=3))


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
    mirrored = known.landmarks(known.camera(0.5), known.parameters()) * [-1, 1] + [known.SIZE[0], 0]
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
