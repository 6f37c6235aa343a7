"""Checks of image files without decoding their pixels: size, bit depth, truncation."""

import mmap
import os
import struct
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from registration.capture.tiff import is_tiff, read_tiff_header, refuse_tiff
from registration.errors import InputError
from registration.storage.exr_files import exr_size, is_exr
from registration.storage.image_files import MAX_PIXELS, image_size, too_many_pixels
from registration.storage.reading import Refuse, open_file

_PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_PNG_END = b"\x00\x00\x00\x00IEND\xaeB`\x82"


@dataclass(frozen=True, kw_only=True)
class Header:
    """The declared properties of an image file."""

    width_px: int
    height_px: int
    png_bits: int | None  # bits per channel; None where the file is not a PNG
    floating: bool = False  # floating-point numbers: an image in linear light


def read_header(path: Path, role: str) -> Header:
    """Read the size and depth that an image file declares.

    Args:
        path: the file.
        role: "image", "mask" ..., for the message.

    Raises:
        InputError: the file is missing, is not an image, or declares more than `MAX_PIXELS`.
    """
    if not os.path.lexists(path):
        raise InputError(
            f"The {role} is missing",
            where=path,
            expected=f"a readable {role} file",
            got="no such file",
            fix="add the file, or remove its view from the COLMAP model",
        )
    fix = "convert it to PNG, JPEG, TIFF or OpenEXR; if it is one, write it again: its header is damaged"
    refuse = partial(InputError, f"The {role} is not a readable image", where=path, fix=fix)
    with open_file(path, refuse) as file:
        start = file.read(26)
    floating = is_exr(start)
    if is_tiff(start):
        width_px, height_px, floating = _tiff_size(path, role, refuse)
    elif floating:
        width_px, height_px = exr_size(path, refuse)
    else:
        width_px, height_px = image_size(path, refuse)
    if floating and role != "image":
        raise refuse_tiff(path, role, "floating-point numbers")
    bits = start[24] if start.startswith(_PNG_SIGNATURE) and len(start) == 26 else None
    return Header(width_px=width_px, height_px=height_px, png_bits=bits, floating=floating)


def _tiff_size(path: Path, role: str, refuse: Refuse) -> tuple[int, int, bool]:
    with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
        try:
            header = read_tiff_header(data)
        except ValueError as error:
            raise refuse(expected="a PNG, JPEG or TIFF file", got=error) from None
    if header.width_px * header.height_px > MAX_PIXELS:
        raise too_many_pixels(path, f"{header.width_px} x {header.height_px}")
    if header.defect is not None:
        raise refuse_tiff(path, role, header.defect)
    return header.width_px, header.height_px, header.floating


def require_size(path: Path, role: str, width_px: int, height_px: int) -> Header:
    """Read the header as `read_header`. Raises InputError also if the size (px) is not the camera's."""
    header = read_header(path, role)
    if (header.width_px, header.height_px) != (width_px, height_px):
        raise InputError(
            f"The {role}'s size is not the camera's",
            where=path,
            expected=f"{width_px} x {height_px} px",
            got=f"{header.width_px} x {header.height_px} px",
            fix=f"store the {role} at the size of the calibrated image, or rescale the camera in the COLMAP model",
        )
    return header


def undecodable(path: Path, role: str) -> Refuse:
    """Return what makes the error for a file whose pixels are damaged."""
    return partial(InputError, f"The {role} cannot be decoded", where=path, fix="copy or write the file again")


def require_complete(path: Path, role: str) -> None:
    """Refuse a truncated PNG or JPEG file. Reads a few bytes at the end, or the heads of a PNG's chunks.

    Damage in the middle is detected when the pixels are decoded.

    Raises:
        InputError: the file is truncated.
    """
    with path.open("rb") as file:
        start = file.read(8)
        size = file.seek(0, os.SEEK_END)
        file.seek(max(0, size - 4096))
        tail = file.read()
    if start == _PNG_SIGNATURE:
        complete = tail.endswith(_PNG_END) or _png_chunks_reach_end(path, size)
    elif start.startswith(b"\xff\xd8"):
        complete = b"\xff\xd9" in tail  # some cameras append a few bytes behind the end marker
    else:
        complete = True
    if not complete:
        raise InputError(
            f"The {role} is truncated",
            where=path,
            expected="a file that ends with its end marker",
            got=f"{size} bytes, then nothing",
            fix="copy or write the file again",
        )


def _png_chunks_reach_end(path: Path, size: int) -> bool:
    """Follow the chunk lengths to IEND, so that bytes after a whole PNG are accepted, as decoders do.

    Pillow's `verify` also accepts files that end within IEND (docs/adr/0010-libraries-of-captures.md).
    """
    with path.open("rb") as file:
        position = len(_PNG_SIGNATURE)
        while position + 12 <= size:
            file.seek(position)
            length, kind = struct.unpack(">I4s", file.read(8))
            position += 12 + length
            if kind == b"IEND":
                return position <= size
    return False
