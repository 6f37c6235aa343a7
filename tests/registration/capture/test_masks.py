from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from registration.capture.pixels import read_mask
from registration.errors import InputError
from registration.types import Camera

HEIGHT_PX, WIDTH_PX = 80, 60
CAMERA = Camera(width_px=WIDTH_PX, height_px=HEIGHT_PX, intrinsics=np.eye(3), T_cam_world=np.eye(4))
Y, X = np.mgrid[:HEIGHT_PX, :WIDTH_PX]
MASK = np.where((X - 30) ** 2 / 20**2 + (Y - 40) ** 2 / 30**2 < 1, 255, 0).astype(np.uint8)
PICTURE = np.stack([40 + X, 90 + Y, 200 - X - Y], -1).astype(np.uint8)


def palette(colour: tuple[int, int, int]) -> Image.Image:
    image = Image.fromarray(MASK // 255).convert("P")
    image.putpalette([0, 0, 0, *colour] + [0] * 762)
    return image


def channels(*values: np.ndarray) -> Image.Image:
    return Image.fromarray(np.dstack(values))


def with_alpha(colours: np.ndarray, alpha: np.ndarray = MASK) -> Image.Image:
    return channels(colours, alpha)


BLACK, WHITE = np.zeros((HEIGHT_PX, WIDTH_PX, 3), np.uint8), np.full((HEIGHT_PX, WIDTH_PX, 3), 255, np.uint8)
NOISE = np.random.default_rng(0).integers(0, 6, MASK.shape).astype(np.uint8)
USED: dict[str, Callable[[], Image.Image]] = {
    "grey": lambda: Image.fromarray(MASK),
    "one bit": lambda: Image.fromarray(MASK).convert("1"),
    "colour channels": lambda: Image.fromarray(MASK).convert("RGB"),
    "16 bits": lambda: Image.fromarray(MASK.astype(np.uint16) * 257),
    "scaled to 245": lambda: Image.fromarray((MASK * (245 / 255)).astype(np.uint8)),
    "scaled to 200": lambda: Image.fromarray((MASK * (200 / 255)).astype(np.uint8)),
    "noisy up to 245": lambda: Image.fromarray(np.where(MASK > 0, 245 - NOISE // 3, NOISE)),
    "16 bits scaled": lambda: Image.fromarray(MASK.astype(np.uint16) * 200),
    "palette in black and white": lambda: palette((255, 255, 255)),
    "palette in black and dark red": lambda: palette((128, 0, 0)),
    "red": lambda: channels(MASK, BLACK[..., :2]),
    "alpha over black": lambda: with_alpha(BLACK),
    "alpha over white": lambda: with_alpha(WHITE),
    "alpha over grey": lambda: with_alpha(WHITE // 2),
    "alpha of a picture": lambda: with_alpha(PICTURE),
    "alpha of a grey picture": lambda: with_alpha(np.repeat(PICTURE[..., :1], 3, 2)),
    "alpha of a picture cut out": lambda: with_alpha(np.where(MASK[..., None] > 0, PICTURE, 0).astype(np.uint8)),
    "alpha of grey": lambda: Image.merge("LA", [Image.fromarray(BLACK[..., 0]), Image.fromarray(MASK)]),
    "alpha scaled to 245": lambda: with_alpha(BLACK, (MASK * (245 / 255)).astype(np.uint8)),
    "alpha equal to grey": lambda: with_alpha(np.repeat(MASK[..., None], 3, 2)),
    "opaque alpha": lambda: with_alpha(np.repeat(MASK[..., None], 3, 2), np.full_like(MASK, 255)),
    "transparent alpha": lambda: with_alpha(np.repeat(MASK[..., None], 3, 2), np.zeros_like(MASK)),
}


@pytest.mark.parametrize("name", USED)
def test_the_subject_is_at_255(tmp_path: Path, name: str) -> None:
    path = tmp_path / "mask.png"
    USED[name]().save(path)
    read = read_mask(path, CAMERA)
    assert (read[MASK > 0] >= 253).all() and (read[MASK == 0] < 10).all()


def test_soft_rims_are_kept(tmp_path: Path) -> None:
    soft = cv2.GaussianBlur(MASK, (0, 0), 1)
    Image.fromarray(soft).save(tmp_path / "mask.png")
    np.testing.assert_allclose(read_mask(tmp_path / "mask.png", CAMERA), soft, atol=6)


def test_an_empty_mask_is_empty(tmp_path: Path) -> None:
    Image.fromarray(np.zeros_like(MASK)).save(tmp_path / "mask.png")
    assert not read_mask(tmp_path / "mask.png", CAMERA).any()


REFUSED: dict[str, tuple[Callable[[], Image.Image], str]] = {
    "ones": (lambda: Image.fromarray(MASK // 255), "no pixel above 1"),
    "8 bits in 16": (lambda: Image.fromarray(MASK.astype(np.uint16)), "16 bits, but no value above 255 of 65535"),
    "dark": (lambda: Image.fromarray((MASK // 3).astype(np.uint8)), "no pixel above 85"),
    "alpha of 1": (lambda: with_alpha(BLACK, MASK // 255), "no pixel above 1"),
    "picture": (lambda: Image.fromarray(PICTURE), "several colours"),
    "picture cut out": (
        lambda: Image.fromarray(np.where(MASK[..., None] > 0, PICTURE, 0).astype(np.uint8)),
        "several colours",
    ),
    "grey picture": (lambda: Image.fromarray((3 * Y + X % 2).astype(np.uint8)), "in between"),
    "alpha against grey": (
        lambda: with_alpha(np.repeat(np.roll(MASK, 9, 1)[..., None], 3, 2)),
        "both, and they differ",
    ),
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_is_no_mask_is_refused_with_the_reason(tmp_path: Path, name: str) -> None:
    image, got = REFUSED[name]
    image().save(tmp_path / "mask.png")
    with pytest.raises(InputError) as caught:
        read_mask(tmp_path / "mask.png", CAMERA)
    assert got in caught.value.got and caught.value.where.endswith("mask.png")
