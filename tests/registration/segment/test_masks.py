"""Masks before any fit, on drawn pictures with a known silhouette."""

import numpy as np
import pytest

from registration.segment.masks import UNCERTAIN, first_masks
from registration.segment.views import SegmentView
from registration.stereo.depth_map import DepthMap
from registration.types import Camera

SIZE = (160, 200)  # width, height
CENTRE, RADIUS = np.array([0.0, 0.0, 1.0]), 0.12
FINE = 4  # samples per pixel along each axis, of the true coverage


def camera() -> Camera:
    intrinsics = np.array([[400.0, 0, 80], [0, 400, 90], [0, 0, 1]])
    return Camera(width_px=SIZE[0], height_px=SIZE[1], intrinsics=intrinsics, T_cam_world=np.eye(4))


def head_coverage() -> np.ndarray:
    """An oval head on a neck that leaves the picture."""
    y, x = (np.mgrid[: SIZE[1] * FINE, : SIZE[0] * FINE] + 0.5) / FINE
    head = ((x - 80) / 36) ** 2 + ((y - 88) / 46) ** 2 < 1
    neck = (np.abs(x - 80) < 20 + np.maximum(y - 150, 0)) & (y > 110)
    return (head | neck).reshape(SIZE[1], FINE, SIZE[0], FINE).mean((1, 3))


def picture(subject: tuple[int, int, int], background: np.ndarray, seed: int = 3) -> np.ndarray:
    rng = np.random.default_rng(seed)
    cover = head_coverage()[..., None]
    skin = np.array(subject) * (1 + 0.08 * rng.normal(size=(*cover.shape[:2], 1)))
    image = cover * skin + (1 - cover) * background + rng.normal(size=(*cover.shape[:2], 3))
    return image.clip(0, 255).round().astype(np.uint8)


def even(value: tuple[int, int, int]) -> np.ndarray:
    return np.ones((SIZE[1], SIZE[0], 1)) * np.array(value, float)


def mask_of(image: np.ndarray, **evidence: object) -> np.ndarray:
    view = SegmentView(name="a", image=image, camera=camera())
    return first_masks([view], CENTRE, RADIUS, **evidence)[0]


@pytest.mark.parametrize("background", [(120, 120, 120), (8, 12, 25), (20, 160, 40)])
def test_a_head_before_an_even_background_has_its_silhouette_to_a_fraction_of_a_pixel(background):
    mask, true = mask_of(picture((190, 140, 115), even(background))), head_coverage()
    assert (mask == UNCERTAIN).mean() < 0.002
    assert ((mask > 0.5) != (true > 0.5)).sum() < 30
    edge = (true > 0.1) & (true < 0.9)
    assert np.abs(mask - true)[edge].mean() < 0.15


def test_a_background_may_fade_from_dark_to_bright():
    fade = even((1, 1, 1)) * np.linspace(10, 110, SIZE[0])[None, :, None]
    mask, true = mask_of(picture((200, 140, 115), fade)), head_coverage()
    assert ((mask > 0.5) != (true > 0.5))[mask != UNCERTAIN].mean() < 0.01


def test_no_silhouette_is_claimed_where_subject_and_background_look_alike():
    mask, true = mask_of(picture((62, 60, 60), even((60, 60, 60)))), head_coverage()
    claimed = (np.abs(mask - 0.5) > 0.01) & ((mask > 0.5) != (true > 0.5))
    assert claimed.sum() < 0.25 * (true > 0.5).sum()


def test_a_plate_tells_a_cluttered_background():
    rng = np.random.default_rng(5)
    clutter = np.kron(rng.uniform(20, 230, (25, 20, 3)), np.ones((8, 8, 1)))
    image = picture((190, 140, 115), clutter)
    plate = (clutter + rng.normal(size=clutter.shape)).clip(0, 255).astype(np.uint8)
    mask, true = mask_of(image, plates=[plate]), head_coverage()
    assert ((mask > 0.5) != (true > 0.5))[mask != UNCERTAIN].mean() < 0.02


def test_depths_tell_what_is_near():
    rng = np.random.default_rng(6)
    clutter = np.kron(rng.uniform(20, 230, (25, 20, 3)), np.ones((8, 8, 1)))
    true = head_coverage()
    depth = np.where(true > 0.5, 0.95, 2.0)
    seen = DepthMap(camera=camera(), depth=depth, normals=np.zeros((*depth.shape, 3)), confidence=np.ones_like(depth))
    mask = mask_of(picture((190, 140, 115), clutter), depths=[seen])
    assert ((mask > 0.5) != (true > 0.5))[mask != UNCERTAIN].mean() < 0.02


def test_a_view_without_the_head_is_uncertain():
    behind = np.eye(4)
    behind[2, 3] = -5
    view = SegmentView(
        name="a",
        image=picture((190, 140, 115), even((60, 60, 60))),
        camera=Camera(width_px=160, height_px=200, intrinsics=camera().intrinsics, T_cam_world=behind),
    )
    assert (first_masks([view], CENTRE, RADIUS)[0] == UNCERTAIN).all()


def test_masks_are_the_same_every_time():
    image = picture((190, 140, 115), even((120, 120, 120)))
    assert np.array_equal(mask_of(image), mask_of(image))


def test_nothing_is_claimed_of_a_close_up_without_background():
    near = Camera(
        width_px=160,
        height_px=200,
        intrinsics=np.array([[1600.0, 0, 80], [0, 1600, 90], [0, 0, 1]]),
        T_cam_world=np.eye(4),
    )
    image = np.random.default_rng(8).integers(100, 140, (200, 160, 3)).astype(np.uint8)
    mask = first_masks([SegmentView(name="a", image=image, camera=near)], CENTRE, RADIUS)[0]
    assert (mask < UNCERTAIN).mean() < 0.01 and (mask == UNCERTAIN).mean() > 0.3
