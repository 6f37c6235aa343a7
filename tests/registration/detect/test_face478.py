"""The real detector on lit renders and on photographs."""

from concurrent.futures import ThreadPoolExecutor

import cv2
import numpy as np
import pytest

from registration.capture import native
from registration.capture.pixels import read_image
from registration.detect.blendshapes import NAMES, SUBSET
from registration.detect.face478 import LEFT_EYE, RIGHT_EYE, Face478Provider
from registration.detect.provider import LandmarkProvider
from registration.detect.providers import load_provider
from registration.errors import InputError
from tests.conftest import SHARED, needs_shared

CAPTURES = SHARED / "data" / "captures"
RIGHT_CORNER, LEFT_CORNER = 61, 291  # of the mouth, the subject's


def image_of(capture: str, view: str) -> np.ndarray:
    found = next(v for v in native.read_capture(CAPTURES / capture).views if v.name == view)
    return read_image(found.image, found.camera)


@pytest.fixture(scope="module")
def frontal() -> np.ndarray:
    return image_of("ict_dev/neutral", "cam07")


def test_names() -> None:
    assert len(NAMES) == len(set(NAMES)) == 52 and len(set(SUBSET)) == 146 and list(SUBSET) == sorted(SUBSET)
    assert isinstance(load_provider("face478"), Face478Provider)
    assert isinstance(Face478Provider(), LandmarkProvider)
    with pytest.raises(InputError, match="no such landmark provider"):
        load_provider("dlib")


def test_a_picture_without_a_face(provider: Face478Provider) -> None:
    noise = np.random.default_rng(0).integers(0, 255, (90, 120, 3)).astype(np.uint8)
    assert list(provider.detect(noise)) == []
    assert list(provider.detect(np.zeros((3, 2, 3), np.uint8))) == []


@needs_shared
def test_a_face(provider: Face478Provider, frontal: np.ndarray) -> None:
    (face,) = provider.detect(frontal)
    assert face.points.shape == (478, 2) and face.presence > 0.8 and (face.confidence <= 1).all()
    assert 0.5 < np.median(face.spread_px) < 4
    # The subject's right is on the image's left.
    assert face.points[RIGHT_EYE, 0] < face.points[LEFT_EYE, 0]
    assert face.points[RIGHT_CORNER, 0] < face.points[LEFT_CORNER, 0]
    eyes, mouth = face.points[[RIGHT_EYE, LEFT_EYE], 1].mean(), face.points[[RIGHT_CORNER, LEFT_CORNER], 1].mean()
    assert face.box[1] < eyes < mouth < face.box[3]
    assert set(face.hints) < set(NAMES) and face.hints["jawOpen"] < 0.2


@needs_shared
def test_an_open_jaw_is_hinted(provider: Face478Provider) -> None:
    (face,) = provider.detect(image_of("ict_dev/jaw_open", "cam07"))
    assert face.hints["jawOpen"] > 0.4


@needs_shared
@pytest.mark.parametrize("scale", [0.5, 2.3])
def test_points_follow_the_image(provider: Face478Provider, frontal: np.ndarray, scale: float) -> None:
    resized = cv2.resize(frontal, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA if scale < 1 else 1)
    (face,), (other,) = provider.detect(frontal), provider.detect(resized)
    moved = np.linalg.norm(other.points / scale - face.points, axis=-1)
    assert np.median(moved) < 1.0  # px of a face of 260 px
    assert np.median(other.spread_px / face.spread_px) == pytest.approx(scale, rel=0.3)


@needs_shared
def test_threads_agree(provider: Face478Provider, frontal: np.ndarray) -> None:
    with ThreadPoolExecutor(4) as pool:
        results = list(pool.map(provider.detect, [frontal] * 4))
    for (face,) in results[1:]:
        np.testing.assert_array_equal(face.points, results[0][0].points)


@needs_shared
def test_a_real_photograph(provider: Face478Provider) -> None:
    for view in ("photo_a", "photo_b"):
        (face,) = provider.detect(image_of("real_two_view/neutral", view))
        assert face.presence > 0.9
