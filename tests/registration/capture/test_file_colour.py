import io
import struct
import zlib
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image, ImageCms

from registration.capture.colour import ENCODINGS, to_rec709
from registration.capture.file_colour import conversion_of
from registration.capture.icc import parse_profile
from registration.errors import InputError
from registration.frames import srgb_to_linear
from registration.types import Colour
from tests.registration.capture.test_colour import light_of, read

HEIGHT_PX, WIDTH_PX = 160, 120
LIGHT = np.random.default_rng(1).uniform(0, 1, (HEIGHT_PX, WIDTH_PX, 3)).astype(np.float32)
P3 = ((0.51512, 0.24120, -0.00105), (0.29198, 0.69225, 0.04189), (0.15710, 0.06657, 0.78407))  # columns, D50
ADOBE = ((0.60974, 0.31111, 0.01947), (0.20528, 0.62567, 0.06087), (0.14919, 0.06322, 0.74457))
SRGB = ((0.43607, 0.22249, 0.01392), (0.38515, 0.71687, 0.09708), (0.14307, 0.06061, 0.71410))


def fixed(*values: float) -> bytes:
    return struct.pack(f">{len(values)}i", *(round(v * 65536) for v in values))


SRGB_CURVE = b"para\0\0\0\0\0\3\0\0" + fixed(2.4, 1 / 1.055, 0.055 / 1.055, 1 / 12.92, 0.04045)
ADOBE_CURVE = b"curv\0\0\0\0\0\0\0\1" + struct.pack(">H", 563) + b"\0\0"
SAMPLED_CURVE = (
    b"curv\0\0\0\0"
    + struct.pack(">I", 1024)
    + (srgb_to_linear(np.linspace(0, 1, 1024)) * 65535).round().astype(">u2").tobytes()
)


def profile(columns: tuple[tuple[float, ...], ...], curve: bytes, space: bytes = b"RGB ", **more: bytes) -> bytes:
    """An ICC profile of version 2.1, built by hand."""
    tags = {f"{c}XYZ": b"XYZ \0\0\0\0" + fixed(*xyz) for c, xyz in zip("rgb", columns, strict=True)}
    tags |= dict.fromkeys(("rTRC", "gTRC", "bTRC"), curve)
    tags["wtpt"] = b"XYZ \0\0\0\0" + fixed(0.9642, 1, 0.8249)
    tags["desc"] = b"desc\0\0\0\0" + struct.pack(">I", 5) + b"test\0" + bytes(78)
    tags |= more
    offset, table, body = 132 + 12 * len(tags), b"", b""
    for name, data in tags.items():
        table += struct.pack(">4sII", name.encode(), offset + len(body), len(data))
        body += data + bytes(-len(data) % 4)
    head = struct.pack(">I4sI4s4s4s", offset + len(body), b"\0\0\0\0", 0x02100000, b"mntr", space, b"XYZ ")
    head += bytes(12) + b"acsp" + bytes(28) + fixed(0.9642, 1, 0.8249)
    return head.ljust(128, b"\0") + struct.pack(">I", len(tags)) + table + body


def colours_8() -> np.ndarray:
    return (LIGHT * 255).round().astype(np.uint8)


def test_an_srgb_image_keeps_its_values(tmp_path: Path) -> None:
    image = colours_8()
    srgb = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()
    for data in (None, srgb, profile(SRGB, SRGB_CURVE), profile(SRGB, SAMPLED_CURVE)):
        Image.fromarray(image).save(tmp_path / "a.png", icc_profile=data)
        Image.fromarray(image).save(tmp_path / "a.tif", icc_profile=data)
        for suffix in ("png", "tif"):
            assert conversion_of(tmp_path / f"a.{suffix}", Colour()) is None
            np.testing.assert_array_equal(read(tmp_path / f"a.{suffix}"), image)


@pytest.mark.parametrize("columns, curve", [(P3, SRGB_CURVE), (ADOBE, ADOBE_CURVE), (P3, SAMPLED_CURVE)])
@pytest.mark.parametrize("suffix", ["png", "tif", "jpg", "webp"])
def test_profiles_are_honoured_as_by_littlecms(
    tmp_path: Path, columns: tuple[tuple[float, ...], ...], curve: bytes, suffix: str
) -> None:
    data, path = profile(columns, curve), tmp_path / f"a.{suffix}"
    smooth = cv2.GaussianBlur(LIGHT, (0, 0), 9)
    image = (255 * (0.3 + 0.4 * (smooth - smooth.min()) / np.ptp(smooth))).astype(np.uint8)
    options = {"jpg": {"quality": 100, "subsampling": 0}, "webp": {"lossless": True}}.get(suffix, {})
    Image.fromarray(image).save(path, icc_profile=data, **options)
    with Image.open(path) as stored:
        source, target = ImageCms.ImageCmsProfile(io.BytesIO(data)), ImageCms.createProfile("sRGB")
        expected = np.array(ImageCms.profileToProfile(stored.convert("RGB"), source, target))
    found = read(path)
    assert found.dtype == np.uint16 and np.abs(found / 257 - expected).max() < 2.0
    assert np.abs(found / 257 - image).max() > 3  # it does something


def test_a_profile_is_honoured_in_16_bits_and_in_grey(tmp_path: Path) -> None:
    values = (LIGHT * 65535).astype(np.uint16)
    path = tmp_path / "a.png"
    cv2.imwrite(str(path), values[..., ::-1])
    content = path.read_bytes()
    packed = b"test\0\0" + zlib.compress(profile(P3, SRGB_CURVE))
    path.write_bytes(content[:33] + chunk(b"iCCP", packed) + content[33:])
    expected = srgb_to_linear(values / 65535) @ to_rec709(ENCODINGS["display_p3"].primaries).T
    np.testing.assert_allclose(light_of(path), expected.clip(0, 1), atol=2e-3)
    grey = profile(P3, ADOBE_CURVE, b"GRAY", kTRC=ADOBE_CURVE)
    Image.fromarray(np.full((HEIGHT_PX, WIDTH_PX), 128, np.uint8)).save(path, icc_profile=grey)
    np.testing.assert_allclose(light_of(path), (128 / 255) ** (563 / 256), atol=1e-4)


def chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def with_chunks(path: Path, *chunks: bytes) -> Path:
    Image.fromarray(colours_8()).save(path)
    content = path.read_bytes()
    path.write_bytes(content[:33] + b"".join(chunks) + content[33:])
    return path


SRGB_CHRM = chunk(b"cHRM", struct.pack(">8I", 31270, 32900, 64000, 33000, 30000, 60000, 15000, 6000))


@pytest.mark.parametrize(
    "chunks",
    [
        (chunk(b"gAMA", struct.pack(">I", 45455)),),
        (chunk(b"gAMA", struct.pack(">I", 45455)), SRGB_CHRM),
        (chunk(b"sRGB", b"\0"), chunk(b"gAMA", struct.pack(">I", 100000))),
        (chunk(b"cICP", bytes([1, 13, 0, 1])), chunk(b"gAMA", struct.pack(">I", 100000))),
    ],
)
def test_chunks_of_srgb_change_nothing(tmp_path: Path, chunks: tuple[bytes, ...]) -> None:
    np.testing.assert_array_equal(read(with_chunks(tmp_path / "a.png", *chunks)), colours_8())


def test_code_points_of_display_p3_are_honoured(tmp_path: Path) -> None:
    path = with_chunks(tmp_path / "a.png", chunk(b"cICP", bytes([12, 13, 0, 1])))
    expected = srgb_to_linear(colours_8() / 255) @ to_rec709(ENCODINGS["display_p3"].primaries).T
    np.testing.assert_allclose(light_of(path), expected.clip(0, 1), atol=1e-4)


def test_adobe_rgb_is_read_from_exif(tmp_path: Path) -> None:
    exif = Image.Exif()
    exif.get_ifd(0x8769)[0xA005] = {1: "R03"}
    image = np.full((HEIGHT_PX, WIDTH_PX, 3), (200, 60, 60), np.uint8)
    Image.fromarray(image).save(tmp_path / "a.jpg", exif=exif, quality=100, subsampling=0)
    expected = ((image[0, 0] / 255) ** (563 / 256)) @ to_rec709(ENCODINGS["adobe_rgb"].primaries).T
    np.testing.assert_allclose(light_of(tmp_path / "a.jpg")[80, 60], expected, atol=0.01)


LUT = profile(P3, SRGB_CURVE, A2B0=b"mft2" + bytes(60))


@pytest.mark.parametrize(
    "make_image, got",
    [
        (lambda p: Image.fromarray(colours_8()).save(p, icc_profile=LUT), "test, made of lookup tables"),
        (
            lambda p: Image.fromarray(colours_8()).save(p, icc_profile=profile(P3, SRGB_CURVE, b"CMYK")),
            "of CMYK colours",
        ),
        (lambda p: Image.fromarray(colours_8()).save(p, icc_profile=b"x" * 200), "a damaged profile"),
        (lambda p: Image.fromarray(colours_8()).save(p, icc_profile=profile(P3, SRGB_CURVE)[:300]), "truncated"),
        (lambda p: Image.fromarray(colours_8()).save(p, icc_profile=profile(P3, b"curv")), "a damaged profile"),
        (lambda p: with_chunks(p, chunk(b"gAMA", struct.pack(">I", 100000))), "a gAMA chunk of 1"),
        (lambda p: with_chunks(p, chunk(b"cICP", bytes([9, 16, 0, 1]))), "a cICP chunk of 9, 16, 0, 1"),
        (
            lambda p: with_chunks(p, chunk(b"cHRM", struct.pack(">8I", *[31270, 32900, 68000, 32000] * 2))),
            "a cHRM chunk",
        ),
        (lambda p: with_chunks(p, chunk(b"iCCP", b"x\0\0junk")), "incorrect"),
    ],
)
def test_colours_that_cannot_be_honoured_are_refused(
    tmp_path: Path, make_image: Callable[[Path], object], got: str
) -> None:
    path = tmp_path / "a.png"
    make_image(path)
    with pytest.raises(InputError, match="colour profile cannot be used") as caught:
        read(path)
    assert got in str(caught.value.got) and "sRGB" in caught.value.fix
    np.testing.assert_allclose(
        light_of(path, Colour(encoding="display_p3")).mean(), 0.37, atol=0.1
    )  # stated: it counts


def test_parametric_curves_of_all_kinds() -> None:
    x = np.array([0.0, 0.01, 0.5, 1.0])
    numbers = {0: (2.0,), 1: (2.0, 0.5, 0.1), 2: (2.0, 0.5, -0.1, 0.2), 4: (2.0, 0.5, 0.1, 0.3, 0.04, 0.05, 0.06)}
    expected = {
        0: x**2,
        1: (0.5 * x + 0.1) ** 2,
        2: np.where(x >= 0.2, (0.5 * x - 0.1) ** 2, 0) + 0.2,
        4: np.where(x >= 0.04, (0.5 * x + 0.1) ** 2 + 0.05, 0.3 * x + 0.06),
    }
    for kind, values in numbers.items():
        curve = b"para\0\0\0\0" + struct.pack(">HH", kind, 0) + fixed(*values)
        found = parse_profile(profile(P3, curve), grey=False).curves[0](x)
        np.testing.assert_allclose(found, expected[kind], atol=2e-5)
