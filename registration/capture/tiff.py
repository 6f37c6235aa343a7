"""Decode TIFF images as they are stored, whatever their tags for display say.

OpenCV turns TIFF images by their orientation tag whatever its flags, multiplies colours by an alpha channel, and
returns zeros for 16 bit RGB unless it is asked for unchanged pixels. Both tags are neutralized before it decodes.
"""

import mmap
import struct
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from registration.errors import InputError
from registration.storage.image_files import decode_content
from registration.storage.reading import Refuse

_WIDTH, _HEIGHT, _BITS, _PHOTOMETRIC, _ORIENTATION = 256, 257, 258, 262, 274
_SAMPLES, _PLANAR, _EXTRA_SAMPLES, _SAMPLE_FORMAT = 277, 284, 338, 339
_PROFILE = 34675
_TYPES = {1: "B", 3: "H", 4: "I", 16: "Q"}  # of whole numbers in a directory
_AS_STORED = {_ORIENTATION: 1, _EXTRA_SAMPLES: 1}  # top left; alpha that is not to be multiplied
_COLOURS = {0: "grey", 1: "grey", 2: "RGB", 3: "palette", 5: "CMYK", 6: "YCbCr"}
_MAX_ENTRIES = 4096


@dataclass(frozen=True, kw_only=True)
class TiffHeader:
    """What the first image of a TIFF file declares."""

    width_px: int
    height_px: int
    bits: int  # per sample
    floating: bool  # 32 bit numbers of linear light
    grey: bool
    profile_at: tuple[int, int] | None  # offset and length of the ICC profile, bytes
    defect: str | None  # why its pixels cannot be used; None: they can
    display_tags: tuple[tuple[int, str, int], ...]  # offset, format and neutral value of tags that change the pixels


def is_tiff(start: bytes) -> bool:
    """Return whether a file that starts with these bytes is a TIFF or BigTIFF file."""
    return start[:4] in (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")


def read_tiff_header(data: bytes | bytearray | mmap.mmap) -> TiffHeader:
    """Read the first directory of a file's content.

    Raises:
        ValueError: the directory is damaged.
    """
    order = "<" if data[:2] == b"II" else ">"
    big = data[2:4] in (b"+\0", b"\0+")

    def unpack(form: str, offset: int) -> tuple[int, ...]:
        try:
            return struct.unpack_from(order + form, data, offset)
        except struct.error:
            raise ValueError("its directory is cut short") from None

    (start,) = unpack("Q", 8) if big else unpack("I", 4)
    (count,) = unpack("Q", start) if big else unpack("H", start)
    if not 0 < count <= _MAX_ENTRIES:
        raise ValueError(f"its directory has {count} entries")
    step, first, inline, form = (20, start + 8, 8, "HHQ") if big else (12, start + 2, 4, "HHI")
    values: dict[int, tuple[int, ...]] = {}
    tags = []
    profile_at = None
    for entry in range(first, first + step * count, step):
        tag, kind, length = unpack(form, entry)
        if tag == _PROFILE and kind in (1, 7) and length > inline:
            profile_at = (unpack("Q" if big else "I", entry + step - inline)[0], length)
            continue
        if kind not in _TYPES or not 0 < length <= _MAX_ENTRIES:
            continue
        at = entry + step - inline
        if struct.calcsize(f"={length}{_TYPES[kind]}") > inline:
            (at,) = unpack("Q" if big else "I", at)
        values[tag] = unpack(f"{length}{_TYPES[kind]}", at)
        if tag in _AS_STORED:
            size = struct.calcsize(f"={_TYPES[kind]}")
            tags += [(at + i * size, order + _TYPES[kind], _AS_STORED[tag]) for i in range(length)]
    if _WIDTH not in values or _HEIGHT not in values:
        raise ValueError("its directory names no size")
    return TiffHeader(
        width_px=values[_WIDTH][0],
        height_px=values[_HEIGHT][0],
        bits=values.get(_BITS, (1,))[0],
        floating=values.get(_SAMPLE_FORMAT, (1,))[0] == 3,
        grey=values.get(_PHOTOMETRIC, (1,))[0] in (0, 1),
        profile_at=profile_at,
        defect=_defect(lambda tag, default: values.get(tag, (default,))),
        display_tags=tuple(tags),
    )


def _defect(values: Callable[[int, int], tuple[int, ...]]) -> str | None:
    bits, formats = set(values(_BITS, 1)), set(values(_SAMPLE_FORMAT, 1))
    (colours, *_), (planar, *_) = values(_PHOTOMETRIC, 1), values(_PLANAR, 1)
    floating = formats == {3} and bits == {32} and colours in (1, 2)
    if formats - {1, 4} and not floating:
        kind = "floating-point" if 3 in formats else "signed or complex"
        return f"{kind} numbers of {max(bits)} bits"
    if not floating and (len(bits) > 1 or not bits <= {1, 4, 8, 16}):
        return f"{'/'.join(map(str, sorted(bits)))} bits per channel"
    if colours not in _COLOURS or (bits == {16} and colours not in (1, 2)):
        return f"{max(bits)} bit pixels of colour space {_COLOURS.get(colours, f'number {colours}')}"
    if (samples := values(_SAMPLES, 1)[0]) > 4:
        return f"{samples} channels"
    if max(bits) > 8 and planar == 2 and samples > 1:
        return f"{max(bits)} bit channels one after another (planar)"
    return None


def refuse_tiff(path: Path, role: str, got: object) -> InputError:
    """Return the error for a TIFF file whose pixels cannot be used."""
    return InputError(
        f"The {role} has an unusable pixel type",
        where=path,
        expected="8 or 16 bits per channel, whole numbers; grey or RGB, channels interleaved",
        got=got,
        fix="convert it to 8 or 16 bit sRGB, or to floating-point numbers of 32 bits in linear light",
    )


def decode_tiff(path: Path, refuse: Refuse) -> np.ndarray:
    """Decode the first image of a TIFF file, pixels as stored: not turned, colours not multiplied by alpha.

    Args:
        path: the file, whose header was checked.
        refuse: makes the error.

    Returns:
        (H, W, 3) RGB, uint8, uint16 or float32.

    Raises:
        InputError: it cannot be decoded, not even in part.
    """
    data = bytearray(path.read_bytes())
    for offset, form, value in read_tiff_header(data).display_tags:
        struct.pack_into(form, data, offset, value)
    pixels = decode_content(data, cv2.IMREAD_UNCHANGED, refuse)
    if pixels.ndim not in (2, 3):
        raise refuse(expected="one image", got=f"an array of shape {pixels.shape}")
    return np.repeat(pixels[..., None], 3, 2) if pixels.ndim == 2 else np.ascontiguousarray(pixels[..., 2::-1])
