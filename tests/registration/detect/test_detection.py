"""Landmarks of whole captures by the real detector, on lit renders of a head."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from registration.capture import native
from registration.capture.pixels import distort_points, undistort_landmarks
from registration.detect.detection import detect_landmarks
from registration.detect.face478 import SCHEME, Face478Provider
from registration.types import Camera, Capture, View
from tests.conftest import SHARED, needs_shared

pytestmark = needs_shared
CAPTURES = SHARED / "data" / "captures"
FRONT = ("cam07", "cam08", "cam13")


def views_of(capture: str, *names: str) -> tuple[View, ...]:
    views = {view.name: view for view in native.read_capture(CAPTURES / capture).views}
    return tuple(views[name] for name in names)


def capture_of(views: tuple[View, ...]) -> Capture:
    return Capture(root=Path("of views"), subject="s", expression="e", views=views)


def changed(view: View, folder: Path, change) -> View:
    """The view with another image."""
    path = folder / f"{view.name}.png"
    cv2.imwrite(str(path), change(cv2.imread(str(view.image))))
    return replace(view, image=path)


@pytest.fixture
def cache(tmp_path, monkeypatch, provider) -> Path:
    """A cache folder of the test's own, once the nets are read."""
    provider.detect(np.zeros((8, 8, 3), np.uint8))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    return tmp_path / "cache" / "gnm-registration" / "landmarks"


def test_views_agree(provider: Face478Provider, cache: Path) -> None:
    """Landmarks, hints, and what a profile shows; the second call reads the cache, whatever is in it."""
    capture = capture_of(views_of("ict_dev/neutral", *FRONT, "cam04"))
    found = detect_landmarks(capture, provider)
    assert found.outcome == "found" and found.usable and found.warnings == ()
    assert [view.state for view in found.views] == ["used", "used", "used", "none"]
    assert "turned away" in found.views[3].note and len(found.views[3].landmarks) == 0
    assert np.nanmedian(found.point_residual_px) < 2.5 and np.isfinite(found.points).all(-1).mean() > 0.9
    eyes = np.linalg.norm(found.points[33] - found.points[263])
    assert 0.075 < eyes < 0.11  # metres between the outer corners
    assert found.hints["jawOpen"] < 0.2
    inside = found.into(capture)
    assert inside.views[0].landmarks[SCHEME].shape == (478, 3) and SCHEME not in inside.views[3].landmarks
    assert inside.views[0].landmark_spread_px[SCHEME].shape == (478,)
    files = sorted(cache.iterdir())
    files[0].write_bytes(b"damaged")
    again = detect_landmarks(capture, provider)
    np.testing.assert_array_equal(again.points, found.points)
    assert files[0].stat().st_size > 100


def test_a_mirrored_image_is_named(provider: Face478Provider, tmp_path: Path) -> None:
    views = views_of("ict_dev/neutral", *FRONT, "cam06")
    mirrored = (*views[:3], changed(views[3], tmp_path, lambda image: image[:, ::-1]))
    found = detect_landmarks(capture_of(mirrored), provider, cache=False)
    assert found.outcome == "found" and found.views[3].state == "refused" and "mirror" in found.views[3].note
    assert any("cam06" in warning for warning in found.warnings)


def test_mirrored_captures_are_refused(provider: Face478Provider, tmp_path: Path) -> None:
    views = views_of("ict_dev/neutral", *FRONT)
    capture = capture_of(tuple(changed(view, tmp_path, lambda image: image[:, ::-1]) for view in views))
    found = detect_landmarks(capture, provider, cache=False)
    assert found.outcome == "mirrored" and not found.usable and "mirrored" in str(found.error(capture))
    assert all(len(view.landmarks) == 0 for view in found.views)


def test_other_moments_are_told(provider: Face478Provider) -> None:
    """The jaw is open in one of four photographs; in another capture the head has moved by 5 mm."""
    closed = views_of("ict_dev/neutral", *FRONT, "cam19")
    mixed = (*views_of("ict_dev/jaw_open", "cam07"), *closed[1:])
    found = detect_landmarks(capture_of(mixed), provider, cache=False)
    assert any("different moments" in warning for warning in found.warnings)
    moved = closed[0].camera.T_cam_world.copy()
    moved[:3, 3] += moved[:3, :3] @ [0.005, 0.002, 0.0]
    views = (replace(closed[0], camera=replace(closed[0].camera, T_cam_world=moved)), *closed[1:])
    found = detect_landmarks(capture_of(views), provider, cache=False)
    assert any("different moments" in warning for warning in found.warnings)


def test_one_view_and_none(provider: Face478Provider) -> None:
    one = detect_landmarks(capture_of(views_of("ict_dev/neutral", "cam07", "cam05")), provider, cache=False)
    assert one.outcome == "one view" and one.usable and "no other confirms" in one.views[0].note
    assert np.isnan(one.points).all() and len(one.views[0].landmarks) == 478
    capture = capture_of(views_of("ict_dev/neutral", "cam05", "cam11"))
    none = detect_landmarks(capture, provider, cache=False)
    assert none.outcome == "no face" and "no face in any of 2 views" in str(none.error(capture))


def test_turned_and_distorted_images(provider: Face478Provider, tmp_path: Path) -> None:
    """Two cameras on their side; landmarks of a third are in the pixels of its distorted image."""
    upright = views_of("ict_dev/neutral", *FRONT)
    plain = detect_landmarks(capture_of(upright), provider, cache=False)

    def on_its_side(view: View) -> View:
        camera = view.camera
        turn = np.eye(4)
        turn[:3, :3] = [[0, 1, 0], [-1, 0, 0], [0, 0, 1]]
        k = camera.intrinsics
        intrinsics = np.array([[k[1, 1], 0, k[1, 2]], [0, k[0, 0], camera.width_px - k[0, 2]], [0, 0, 1.0]])
        turned = Camera(
            width_px=camera.height_px,
            height_px=camera.width_px,
            intrinsics=intrinsics,
            T_cam_world=turn @ camera.T_cam_world,
        )
        return replace(changed(view, tmp_path, np.rot90), camera=turned)

    lens = replace(upright[0].camera, distortion=(0.3, 0.0, 0.0, 0.0))
    views = (replace(upright[0], camera=lens), *(on_its_side(view) for view in upright[1:]))
    found = detect_landmarks(capture_of(views), provider, cache=False)
    assert found.outcome == "found" and {view.state for view in found.views[1:]} == {"used"}
    # The lens was not there when the image was made: the landmarks lie where they were in the stored image.
    moved = np.linalg.norm(found.views[0].landmarks[:, :2] - plain.views[0].landmarks[:, :2], axis=-1)
    assert np.median(moved) < 2.5
    given = replace(views[0], landmarks={SCHEME: found.views[0].landmarks})
    ideal = undistort_landmarks(given, SCHEME)[:, :2]
    np.testing.assert_allclose(distort_points(lens, ideal), found.views[0].landmarks[:, :2], atol=1e-3)


def test_small_faces_are_found_in_tiles(provider: Face478Provider, tmp_path: Path) -> None:
    """Faces of 60 px in images of 2400 x 1800."""

    def small(view: View) -> View:
        scale, corner = 60 / 265, (1500, 300)
        image = cv2.resize(cv2.imread(str(view.image)), None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
        room = np.full((1800, 2400, 3), 100, np.uint8)
        room[corner[1] : corner[1] + image.shape[0], corner[0] : corner[0] + image.shape[1]] = image
        path = tmp_path / f"{view.name}.png"
        cv2.imwrite(str(path), room)
        camera = view.camera.scaled(image.shape[1], image.shape[0]).cropped(-corner[0], -corner[1], 2400, 1800)
        return replace(view, image=path, camera=camera)

    views = tuple(small(view) for view in views_of("ict_dev/neutral", "cam07", "cam13"))
    found = detect_landmarks(capture_of(views), provider, cache=False)
    assert found.outcome == "found" and all("tiles" in view.note for view in found.views)
    assert np.nanmedian(found.point_residual_px) < 0.6


def test_the_larger_of_two_people_or_the_one_that_views_agree_on(provider: Face478Provider, tmp_path: Path) -> None:
    views = []
    for view in views_of("ict_dev/neutral", *FRONT):
        (other,) = views_of("gnm_identity_a/neutral", "cam13")  # the same picture beside every view
        beside = cv2.imread(str(other.image))
        wide = changed(view, tmp_path, lambda image, beside=beside: np.hstack([image, beside]))
        views.append(replace(wide, camera=replace(view.camera, width_px=960)))
    found = detect_landmarks(capture_of(tuple(views)), provider, cache=False)
    assert found.outcome == "found" and any("more than one face" in warning for warning in found.warnings)
    for view in found.views:
        assert view.chosen is not None and view.faces[view.chosen].points[:, 0].max() < 480


def test_two_real_photographs(provider: Face478Provider) -> None:
    capture = native.read_capture(CAPTURES / "real_two_view/neutral")
    found = detect_landmarks(capture, provider, cache=False)
    assert found.outcome == "found" and not found.warnings
    assert np.nanmedian(found.point_residual_px) < 2.0
