"""Photographs are decoded upright, and EXIF's focal length is read."""

from pathlib import Path

import numpy as np
import pytest
from PIL import Image, ImageOps

from registration.errors import InputError
from registration.footage.moment import focal_lengths
from registration.footage.stills import read_stills, turned_upright

ORIENTATION, EXIF, FOCAL_35MM = 0x0112, 0x8769, 0xA405


def write(file: Path, pixels: np.ndarray, orientation: int = 1, focal_mm: int | None = None) -> Path:
    image = Image.fromarray(pixels)
    exif = image.getexif()
    exif[ORIENTATION] = orientation
    if focal_mm is not None:
        exif.get_ifd(EXIF)[FOCAL_35MM] = focal_mm
    image.save(file, exif=exif)
    return file


@pytest.mark.parametrize("orientation", range(1, 9))
def test_images_are_turned_as_exif_says(tmp_path: Path, orientation: int) -> None:
    pixels = np.random.default_rng(0).integers(0, 255, (6, 10, 3)).astype(np.uint8)
    file = write(tmp_path / "a.png", pixels, orientation)
    (still,) = read_stills(file)
    with Image.open(file) as image:
        assert np.array_equal(still.pixels, np.asarray(ImageOps.exif_transpose(image)))
    assert still.orientation == orientation and still.size_px == still.pixels.shape[1::-1]


def test_a_wrong_orientation_turns_nothing() -> None:
    pixels = np.arange(18, dtype=np.uint8).reshape(2, 3, 3)
    assert np.array_equal(turned_upright(pixels, 9), pixels)


def test_focal_lengths_of_exif_are_a_guess_for_cameras_that_agree(tmp_path: Path) -> None:
    pixels = np.zeros((24, 36, 3), np.uint8)
    write(tmp_path / "a.jpg", pixels, focal_mm=50)
    write(tmp_path / "b.jpg", pixels, orientation=6, focal_mm=50)
    stills = read_stills(tmp_path)
    assert [still.group for still in stills] == [0, 0]
    known, guess, words = focal_lengths(stills, None)
    assert known == [None, None] and guess == pytest.approx(50 / 36) and "EXIF" in words
    assert focal_lengths(stills, 70.0)[0] == [70.0, 70.0]
    write(tmp_path / "b.jpg", pixels, focal_mm=80)
    known, guess, _ = focal_lengths(read_stills(tmp_path), None)
    assert guess is None and known == pytest.approx([50.0, 80.0])
    write(tmp_path / "b.jpg", pixels)
    assert focal_lengths(read_stills(tmp_path), None)[:2] == ([None, None], None)


def test_a_file_that_is_no_image_is_refused(tmp_path: Path) -> None:
    (tmp_path / "a.png").write_bytes(b"no image")
    with pytest.raises(InputError, match="photograph cannot be read"):
        read_stills(tmp_path / "a.png")
