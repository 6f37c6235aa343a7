"""Images: declared sizes, damage that decoders only mention on the standard error, files that are none."""

import os
import struct
import sys
import zlib
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import pytest

from registration.errors import InputError
from registration.storage.image_files import decode, image_size

FLAGS = cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION


def refuse(file: Path):
    return partial(InputError.unreadable, "image", where=file, fix="write it again")


@pytest.fixture
def picture() -> np.ndarray:
    noise = np.random.default_rng(0).integers(0, 256, (240, 160, 3), np.uint8)
    return cv2.GaussianBlur(noise, (0, 0), 3)


def chunk(kind: bytes, content: bytes) -> bytes:
    return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content))


def png(width: int, height: int, data: bytes) -> bytes:
    head = chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0))
    return b"\x89PNG\r\n\x1a\n" + head + chunk(b"IDAT", data) + chunk(b"IEND", b"")


@pytest.mark.parametrize(("width", "height"), [(60_000, 60_000), (2**31 - 1, 2**31 - 1), (2**30, 1), (0, 0)])
def test_a_bomb_is_refused_by_its_header(tmp_path, width, height):
    file = tmp_path / "a.png"
    file.write_bytes(png(width, height, zlib.compress(bytes(100))))
    with pytest.raises(InputError):
        image_size(file, refuse(file))


@pytest.mark.parametrize("content", [b"", b"hello", b"\x89PNG\r\n\x1a\n", b"%!PS-Adobe-3.0 EPSF-3.0\n", b"II*\0" * 9])
def test_other_files_are_no_images(tmp_path, content):
    file = tmp_path / "a.png"
    file.write_bytes(content)
    for read in (image_size, lambda file, refuse: decode(file, FLAGS, refuse)):
        with pytest.raises(InputError):
            read(file, refuse(file))


@pytest.mark.parametrize("suffix", ["png", "jpg", "tif"])
def test_damage_in_the_middle_is_refused(tmp_path, picture, suffix, capfd):
    file = tmp_path / f"a.{suffix}"
    cv2.imwrite(str(file), picture)
    content = bytearray(file.read_bytes())
    content[len(content) // 2 : len(content) // 2 + 40] = b"\xff" * 40
    file.write_bytes(content)
    assert image_size(file, refuse(file)) == (160, 240)
    with pytest.raises(InputError, match="image cannot be read"):
        decode(file, FLAGS, refuse(file))
    assert capfd.readouterr().err == ""


@pytest.mark.parametrize("data", [zlib.compress(bytes(5)), zlib.compress(bytes(17 * 16))[:-6], b"\xff" * 50, b""])
def test_pixels_that_end_early_are_refused(tmp_path, data):
    file = tmp_path / "a.png"
    file.write_bytes(png(16, 16, data))
    with pytest.raises(InputError):
        decode(file, FLAGS, refuse(file))


def test_extraneous_bytes_in_a_jpeg_are_harmless(tmp_path, picture, capfd):
    file = tmp_path / "a.jpg"
    cv2.imwrite(str(file), picture)
    content = file.read_bytes()
    file.write_bytes(content[:-2] + bytes(7) + content[-2:])
    assert decode(file, FLAGS, refuse(file)).shape == (240, 160, 3)
    assert capfd.readouterr().err == ""


def test_lines_of_others_on_the_standard_error_are_passed_on(tmp_path, picture, capfd, monkeypatch):
    file = tmp_path / "a.png"
    cv2.imwrite(str(file), picture)
    real = cv2.imread

    def chatty(*arguments):
        os.write(2, b"a line of another thread\n")
        return real(*arguments)

    monkeypatch.setattr(cv2, "imread", chatty)
    monkeypatch.setattr(sys, "stderr", os.fdopen(os.dup(2), "w", buffering=1))
    decode(file, FLAGS, refuse(file))
    sys.stderr.close()
    assert capfd.readouterr().err == "a line of another thread\n"


def test_a_pipe_is_refused(tmp_path):
    os.mkfifo(tmp_path / "a.png")
    for read in (image_size, lambda file, refuse: decode(file, FLAGS, refuse)):
        with pytest.raises(InputError, match="a named pipe"):
            read(tmp_path / "a.png", refuse(tmp_path / "a.png"))
