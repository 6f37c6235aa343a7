import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from bench.calibrate import compare
from registration.calibrate.calibration import calibrate_photographs
from registration.calibrate.options import CalibrateOptions
from registration.calibrate.result import Calibration, summary
from registration.calibrate.write import write_calibration
from registration.capture.native import read_capture
from registration.detect.provider import Face
from registration.errors import InputError
from registration.types import Capture
from tests.conftest import SHARED, needs_shared

pytestmark = needs_shared
MODEL = SHARED / "data/gnm/gnm_head_reconstructed.npz"
VIEWS = ("cam05", "cam06", "cam07", "cam08", "cam09", "cam12", "cam14")
PROFILE = "cam05"


class StoredLandmarks:
    """A provider that knows the images of a capture: its 68 landmarks, but none in profile; noise of 1 px."""

    scheme, count, version = "68", 68, "of the capture"

    def __init__(self, capture: Capture) -> None:
        generator = np.random.default_rng(0)
        self._known = {}
        for view in capture.views:
            points = view.landmarks["68"][:, :2] + generator.normal(size=(68, 2))
            self._known[cv2.imread(str(view.image), cv2.IMREAD_COLOR_RGB).tobytes()] = (view.name, points)

    def detect(self, image: np.ndarray) -> Sequence[Face]:
        name, points = self._known.get(image.tobytes(), (PROFILE, np.zeros((68, 2))))
        if name == PROFILE:
            return []
        box = np.concatenate([points.min(0), points.max(0)])
        face = Face(points=points, confidence=np.ones(68), spread_px=np.ones(68), presence=1.0, box=box)
        return [face]


@pytest.fixture(scope="module")
def capture() -> Capture:
    whole = read_capture(SHARED / "data/captures/ict_dev/neutral")
    return replace(whole, views=tuple(view for view in whole.views if view.name in VIEWS))


@pytest.fixture(scope="module")
def calibration(capture: Capture) -> Calibration:
    return calibrate_photographs([view.image for view in capture.views], MODEL, provider=StoredLandmarks(capture))


def test_cameras_are_found_to_a_pixel_and_the_head_to_some_percent(capture: Capture, calibration: Calibration) -> None:
    assert [view.photograph.name for view in calibration.views] == list(VIEWS) and not calibration.left_out
    scale, errors = compare(calibration, capture)
    assert max(errors.values()) < 1.0
    assert scale == pytest.approx(1.0, abs=0.06)
    (group,) = calibration.groups
    true = np.mean([view.camera.intrinsics[0, 0] for view in capture.views])
    assert group.focal_px == pytest.approx(true, rel=0.04) and 0 < group.sigma_px < 0.03 * true
    assert group.source == "unknown" and group.k1 == 0
    head = calibration.landmarks[27:36]  # the nose, in the head's frame
    assert head[:, 2].mean() > 0.05 and np.abs(head[:, 0]).max() < 0.03


def test_a_view_without_a_face_is_posed_by_its_features(calibration: Calibration) -> None:
    (profile,) = [view for view in calibration.views if view.photograph.name == PROFILE]
    assert profile.landmarks == 0 and profile.tracks > 50 and profile.tracks_rms_px < 0.5


def test_the_capture_can_be_read_and_says_how_it_was_made(
    calibration: Calibration, capture: Capture, tmp_path: Path
) -> None:
    options = CalibrateOptions(subject="someone")
    out = write_calibration(calibration, tmp_path / "out", options)
    written = read_capture(out)
    assert written.subject == "someone" and [view.name for view in written.views] == list(VIEWS)
    for view, original in zip(written.views, capture.views, strict=True):
        assert view.image.read_bytes() == original.image.read_bytes()
        np.testing.assert_allclose(view.camera.T_cam_world, calibration.cameras[view.name].T_cam_world, atol=1e-12)
    assert written.head is not None
    record = json.loads((out / "calibration.json").read_text("utf-8"))
    assert record["kind"] == "gnm-camera-calibration" and set(record["views"]) == set(VIEWS)
    assert record["groups"][0]["focal_sigma_px"] > 0 and record["left_out"] == {}
    for picture in ("rig.png", "residuals.png"):
        assert cv2.imread(str(out / picture)).shape[1] >= 600
    with pytest.raises(InputError, match="exists already"):
        write_calibration(calibration, out, options)
    assert "7 photographs calibrated" in summary(calibration)


@pytest.mark.slow
def test_a_mirrored_photograph_a_copy_and_a_stranger_are_left_out_with_the_reason(
    capture: Capture, tmp_path: Path
) -> None:
    files = []
    for view in capture.views:
        pixels = cv2.imread(str(view.image))
        file = tmp_path / view.image.name
        cv2.imwrite(str(file), pixels[:, ::-1] if view.name == "cam08" else pixels)
        files.append(file)
    (tmp_path / "copy.png").write_bytes(files[1].read_bytes())
    other = read_capture(SHARED / "data/captures/gnm_identity_a/neutral")
    (stranger,) = [view for view in other.views if view.name == "cam07"]
    (tmp_path / "stranger.png").write_bytes(stranger.image.read_bytes())

    class Mirrored(StoredLandmarks):
        """A face that is mirrored is a face."""

        def __init__(self, capture: Capture) -> None:
            super().__init__(capture)
            (turned,) = [view for view in capture.views if view.name == "cam08"]
            pixels = cv2.imread(str(turned.image), cv2.IMREAD_COLOR_RGB)
            (other,) = [view for view in capture.views if view.name == "cam07"]
            self._known[np.ascontiguousarray(pixels[:, ::-1]).tobytes()] = ("cam08", other.landmarks["68"][:, :2])
            pixels = cv2.imread(str(stranger.image), cv2.IMREAD_COLOR_RGB)
            self._known[pixels.tobytes()] = ("stranger", stranger.landmarks["68"][:, :2])

    result = calibrate_photographs(tmp_path, MODEL, provider=Mirrored(capture))
    assert {"cam08", "stranger"} < set(result.left_out) and len(result.left_out) == 3
    assert "another person" in result.left_out["stranger"]
    assert "mirrored" in result.left_out["cam08"]
    assert compare(result, capture)[1] and max(compare(result, capture)[1].values()) < 1.0


def test_a_known_distance_of_cameras_gives_the_scale(capture: Capture, calibration: Calibration) -> None:
    centres = {view.name: view.camera.centre for view in capture.views}
    metres = float(np.linalg.norm(centres["cam06"] - centres["cam09"]))
    images = [view.image for view in capture.views if view.name in ("cam06", "cam07", "cam09")]
    options = CalibrateOptions(camera_distance=("cam06", "cam09", metres))
    result = calibrate_photographs(images, MODEL, options, provider=StoredLandmarks(capture))
    found = {name: camera.centre for name, camera in result.cameras.items()}
    assert np.linalg.norm(found["cam06"] - found["cam09"]) == pytest.approx(metres)
    assert compare(result, capture)[0] == pytest.approx(1.0, abs=0.02)
    assert result.size.sigma < 0.01 and result.size.head_scale != 1 and calibration.size.head_scale == 1


@pytest.mark.parametrize(
    "changes",
    [
        {"camera_distance": ("cam06", "cam99", 1.0)},
        {"camera_distance": ("cam06", "cam06", 1.0)},
        {"pupil_distance_mm": 63.0},  # of landmarks without pupils
    ],
)
def test_lengths_that_cannot_be_used_are_refused(capture: Capture, changes: dict[str, Any]) -> None:
    images = [view.image for view in capture.views]
    with pytest.raises(InputError):
        calibrate_photographs(images, MODEL, CalibrateOptions(**changes), provider=StoredLandmarks(capture))


def test_two_photographs_need_a_focal_length(capture: Capture) -> None:
    images = [view.image for view in capture.views if view.name in ("cam07", "cam08")]
    with pytest.raises(InputError) as error:
        calibrate_photographs(images, MODEL, provider=StoredLandmarks(capture))
    assert "--focal-px" in error.value.fix
    result = calibrate_photographs(images, MODEL, CalibrateOptions(focal_px=1866.0), provider=StoredLandmarks(capture))
    assert result.groups[0].focal_px == 1866.0 and result.groups[0].source == "given"
    assert max(compare(result, capture)[1].values()) < 2.0


def test_photographs_without_faces_and_models_without_a_map_are_refused(capture: Capture) -> None:
    class Blind(StoredLandmarks):
        def detect(self, image: np.ndarray) -> Sequence[Face]:
            return []

    images = [view.image for view in capture.views][:3]
    with pytest.raises(InputError, match="Too few photographs show a face"):
        calibrate_photographs(images, MODEL, provider=Blind(capture))

    class Other(StoredLandmarks):
        scheme = "other"

    with pytest.raises(InputError, match="no map"):
        calibrate_photographs(images, MODEL, provider=Other(capture))


@pytest.mark.parametrize(
    "changes", [{"focal_px": -3.0}, {"focal_px": float("nan")}, {"focal_spread": 2.0}, {"pupil_distance_mm": 0.063}]
)
def test_options_out_of_range_are_refused(changes: dict[str, float]) -> None:
    with pytest.raises(InputError, match="out of range"):
        CalibrateOptions(**changes)  # type: ignore[arg-type]
