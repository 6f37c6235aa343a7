"""Images in every container and with every display tag are read as they are stored."""

import struct
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from registration.capture.headers import read_header
from registration.capture.pixels import read_image, read_mask
from registration.errors import InputError
from registration.types import Camera

HEIGHT, WIDTH = 32, 48
ROW, COLUMN = np.mgrid[:HEIGHT, :WIDTH]
RGB = np.stack([5 * COLUMN, 7 * ROW, 3 * (ROW + COLUMN)], -1).astype(np.uint8)
RGB16 = RGB.astype(np.uint16) * 257
ALPHA = (5 * COLUMN).astype(np.uint8)[..., None]
CAMERA = Camera(width_px=WIDTH, height_px=HEIGHT, intrinsics=np.diag([50.0, 50.0, 1.0]), T_cam_world=np.eye(4))


def assert_stored(file: Path, expected: np.ndarray = RGB, tolerance: float = 0.0) -> None:
    pixels = read_image(file, CAMERA)
    assert pixels.dtype == expected.dtype
    assert np.abs(pixels.astype(float) - expected).mean() <= tolerance


@pytest.mark.parametrize("orientation", range(1, 9))
def test_pictures_are_not_turned(tmp_path: Path, orientation: int) -> None:
    exif = Image.Exif()
    exif[0x112] = orientation
    for suffix, tolerance in ((".png", 0), (".webp", 0), (".jpg", 1)):
        file = tmp_path / f"a{suffix}"
        Image.fromarray(RGB).save(file, exif=exif, lossless=True, quality=98, subsampling=0)
        assert_stored(file, tolerance=tolerance)
    tifffile = pytest.importorskip("tifffile", reason="tifffile is not installed: make setup")
    for byteorder in "<>":
        for big in (False, True):
            for pixels in (RGB, RGB16):
                tags = [(274, "H", 1, orientation, True)]
                options = {"photometric": "rgb", "byteorder": byteorder, "bigtiff": big, "extratags": tags}
                tifffile.imwrite(tmp_path / "a.tif", pixels, metadata=None, **options)
                assert_stored(tmp_path / "a.tif", pixels)
    header = read_header(tmp_path / "a.tif", "image")
    assert (header.width_px, header.height_px) == (WIDTH, HEIGHT)


def test_alpha_is_ignored(tmp_path: Path) -> None:
    half = np.concatenate([RGB, ALPHA], -1)
    for suffix in (".tif", ".png", ".webp"):
        Image.fromarray(half).save(tmp_path / f"a{suffix}", lossless=True, exact=True)
        assert_stored(tmp_path / f"a{suffix}")
    half16 = np.concatenate([RGB16[..., ::-1], ALPHA.astype(np.uint16) * 257], -1)
    for suffix in (".tif", ".png"):
        cv2.imwrite(str(tmp_path / f"deep{suffix}"), half16)
        assert_stored(tmp_path / f"deep{suffix}", RGB16)
    palette = Image.fromarray(RGB).quantize(200)
    shown = np.asarray(palette.convert("RGB"))
    for transparency in (bytes([128] * 200), 3):
        palette.save(tmp_path / "palette.png", transparency=transparency)
        assert_stored(tmp_path / "palette.png", shown)
    Image.fromarray(RGB).save(tmp_path / "key.png", transparency=tuple(map(int, RGB[3, 4])))
    assert_stored(tmp_path / "key.png")


def test_every_usable_kind_of_tiff_has_the_pngs_colours(tmp_path: Path) -> None:
    file = tmp_path / "a.tif"
    for compression in ("raw", "tiff_lzw", "tiff_deflate", "packbits"):
        Image.fromarray(RGB).save(file, compression=compression)
        assert_stored(file)
    Image.fromarray(RGB).convert("CMYK").save(file)
    assert_stored(file)
    Image.fromarray(RGB).convert("CMYK").save(tmp_path / "a.jpg", quality=98)
    assert_stored(tmp_path / "a.jpg", tolerance=2)
    cv2.imwrite(str(file), RGB16[..., ::-1])
    assert_stored(file, RGB16)
    for grey in (RGB[..., 0], RGB16[..., 0]):
        for suffix in (".tif", ".png"):
            cv2.imwrite(str(tmp_path / f"grey{suffix}"), grey)
            assert_stored(tmp_path / f"grey{suffix}", np.repeat(grey[..., None], 3, -1))
    Image.fromarray(RGB).save(file, save_all=True, append_images=[Image.fromarray(255 - RGB)])
    assert_stored(file)  # the first page
    mask = np.where(ALPHA[..., 0] > 60, 255, 0).astype(np.uint8)
    cv2.imwrite(str(file), mask)
    np.testing.assert_array_equal(read_mask(file, CAMERA), mask)


def test_unusable_pixels_are_named_before_decoding(tmp_path: Path) -> None:
    file = tmp_path / "a.tif"
    for pixels, reason in (
        (RGB.astype(np.float64) / 255, "floating-point numbers of 64 bits"),
        (ALPHA[..., 0].astype(np.int32), "signed"),
    ):
        cv2.imwrite(str(file), pixels)
        with pytest.raises(InputError, match="unusable pixel type") as caught:
            read_header(file, "image")
        assert reason in caught.value.got and "sRGB" in caught.value.fix
    Image.fromarray(RGB).convert("LAB").save(file)
    with pytest.raises(InputError, match="unusable pixel type"):
        read_header(file, "image")


def test_damaged_directories_are_refused(tmp_path: Path) -> None:
    Image.fromarray(RGB).save(tmp_path / "whole.tif")
    whole = (tmp_path / "whole.tif").read_bytes()
    (start,) = struct.unpack_from("<I", whole, 4)
    file = tmp_path / "a.tif"
    for size in (4, 7, 8, start + 1, start + 30):
        file.write_bytes(whole[:size])
        with pytest.raises(InputError, match="not a readable image"):
            read_header(file, "image")
    file.write_bytes(whole[:start] + b"\xff\xff" + whole[start + 2 :])
    with pytest.raises(InputError, match="not a readable image"):
        read_header(file, "image")
    file.write_bytes(whole[:4] + b"\xff\xff\xff\xff" + whole[8:])
    with pytest.raises(InputError, match="not a readable image"):
        read_header(file, "image")


def test_a_file_of_another_kind_is_not_called_damaged(tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "a.hdr"), RGB.astype(np.float32))
    with pytest.raises(InputError, match="not a readable image") as caught:
        read_header(tmp_path / "a.hdr", "image")
    assert "convert it to PNG" in caught.value.fix
