import cv2
import numpy as np
import pytest

from registration.detect.crops import Crop


@pytest.mark.parametrize("roll", [0.0, 0.7, -2.0])
def test_points_return_from_a_crop(roll: float) -> None:
    crop = Crop(centre=np.array([40.0, 70]), side=33.0, roll=roll).moved((0.1, -0.2), 1.3, 0.2)
    points = np.random.default_rng(0).uniform(0, 100, (20, 2))
    np.testing.assert_allclose(crop.to_image(crop.from_image(points)), points, atol=1e-9)


def test_a_square_around_points_holds_them_tightly() -> None:
    points = np.random.default_rng(1).uniform(0, 100, (50, 2))
    local = Crop.around(points, 0.5, 1.0).from_image(points)
    assert local.min() == pytest.approx(0, abs=1e-9) and local.max() == pytest.approx(1, abs=1e-9)
    np.testing.assert_allclose(local.min(0) + local.max(0), 1, atol=1e-9)


@pytest.mark.parametrize("black", [False, True])
@pytest.mark.parametrize(("side", "roll"), [(64.0, 0.0), (90.0, 0.6), (300.0, -1.0), (700.0, 2.5)])
def test_pixels_lie_where_points_say(side: float, roll: float, black: bool) -> None:
    """A smooth blob's centroid in the crop is its place, at any size and turn."""
    place = np.array([210.3, 171.9])
    y, x = np.mgrid[:360, :480] + 0.5
    blob = 255 * np.exp(-((x - place[0]) ** 2 + (y - place[1]) ** 2) / (2 * (side / 20) ** 2))
    image = np.repeat(blob[..., None], 3, -1).astype(np.uint8)
    crop = Crop(centre=np.array([200.0, 180]), side=side, roll=roll)
    pixels = crop.pixels(image, 64, black=black)[..., 1].astype(float)
    rows, columns = np.mgrid[:64, :64] + 0.5
    found = np.array([(columns * pixels).sum(), (rows * pixels).sum()]) / pixels.sum() / 64
    np.testing.assert_allclose(found, crop.from_image(place[None])[0], atol=2e-3)


def test_a_large_crop_does_not_alias() -> None:
    stripes = np.zeros((1024, 1024, 3), np.uint8)
    stripes[:, ::2] = 255
    pixels = Crop.whole(stripes).pixels(stripes, 128)
    assert np.abs(pixels[4:-4, 4:-4].astype(float) - 127.5).max() < 2


def test_beyond_the_image() -> None:
    white = np.full((20, 40, 3), 255, np.uint8)
    assert Crop.whole(white).pixels(white, 40, black=True)[..., 0].mean() == pytest.approx(127.5, abs=5)
    assert Crop.whole(white).pixels(white, 40).min() == 255
    far = Crop(centre=np.array([-500.0, 900]), side=50.0)
    assert far.pixels(white, 16, black=True).max() == 0
    assert cv2.countNonZero(far.pixels(white, 16)[..., 0]) == 256
