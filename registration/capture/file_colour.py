"""What an image file itself says about its colours: an ICC profile, or a PNG's chunks."""

import mmap
import struct
import zlib
from functools import partial
from pathlib import Path

import numpy as np
from PIL import Image

from registration.capture.colour import ENCODINGS, Chromaticities, Conversion, stated_conversion
from registration.capture.icc import MAX_BYTES, Profile, parse_profile
from registration.capture.tiff import is_tiff, read_tiff_header
from registration.errors import InputError
from registration.frames import srgb_to_linear
from registration.storage.exr_files import exr_primaries, is_exr
from registration.storage.image_files import FORMATS
from registration.storage.reading import open_file
from registration.types import Colour, View

_PNG = b"\x89PNG\r\n\x1a\n"
_INTEROPERABILITY = 0xA005  # EXIF directory
_SAME = 2 / 255  # difference of curves and matrices at which a profile is sRGB: writers round
_SRGB_GAMMA = (0.4, 0.5)  # of a PNG's gAMA chunk: 1 / 2.2 within what programs write for sRGB
_CHROMATICITIES = (0.3127, 0.3290, 0.64, 0.33, 0.30, 0.60, 0.15, 0.06)  # of sRGB, as in cHRM: white, red, green, blue
_FIX = "convert the image to sRGB where it was developed, or write its encoding in [colour] of capture.toml"


def conversion_of(path: Path, colour: Colour) -> Conversion | None:
    """Return how the values of an image file become sRGB; None: they are sRGB.

    An encoding that the capture states counts, whatever the file says; if neither says anything, it is sRGB.

    Raises:
        InputError: the file has a profile or chunks that are damaged or cannot be honoured.
    """
    if colour.encoding != "srgb":
        return stated_conversion(colour, _exr_primaries(path) if colour.encoding == "linear" else None)
    own = _profile(path)
    if own is None:
        return None if colour == Colour() else stated_conversion(colour)
    red, green, blue = own.curves
    return Conversion(name=own.name, curves=(red, green, blue), primaries=own.primaries, colour=colour)


def colour_name(view: View) -> str:
    """Return what a view's image is read as, for people: sRGB, or its encoding or profile, with matrix and gain.

    Raises:
        InputError: as `conversion_of`.
    """
    conversion = conversion_of(view.image, view.colour)
    if conversion is None:
        return "sRGB"
    colour = view.colour
    matrix = ["a matrix"] * (colour.matrix is not None)
    return ", ".join([conversion.name, *matrix, *[f"gain {colour.gain:g}"] * (colour.gain != 1)])


def _profile(path: Path) -> Profile | None:
    """What the file says, unless it is sRGB. Raises InputError."""
    unreadable = partial(InputError, "The image cannot be read", where=path, fix="copy or write the file again")
    with open_file(path, unreadable) as file:
        start = file.read(8)
    grey, data = False, None
    try:
        if start == _PNG:
            found = _png(path)
            if not isinstance(found, bytes):
                return found
            data = found
        elif is_exr(start):
            return None
        elif is_tiff(start):
            data, grey = _tiff(path)
        else:
            with Image.open(path, formats=FORMATS) as image:
                data, grey = image.info.get("icc_profile"), image.mode in ("L", "LA", "1", "I;16")
                if not data and _is_adobe(image):
                    adobe = stated_conversion(Colour(encoding="adobe_rgb"))
                    return Profile(name="Adobe RGB", curves=adobe.curves, primaries=adobe.primaries)
        if not data:
            return None
        if len(data) > MAX_BYTES:
            raise ValueError(f"a profile of {len(data)} bytes")
        profile = parse_profile(data, grey=grey or data[16:20] == b"GRAY")
    except InputError:
        raise
    except Exception as error:  # a damaged file makes Pillow raise nearly anything
        raise InputError(
            "The image's colour profile cannot be used",
            where=path,
            expected="sRGB, or a profile of RGB curves and a matrix, as Display P3 and Adobe RGB have",
            got=error,
            fix=_FIX,
        ) from None
    return None if _is_srgb(profile) else profile


def _is_adobe(image: Image.Image) -> bool:
    """Whether a photograph without a profile says in its EXIF that it is Adobe RGB [DCF 2.0: interoperability R03]."""
    if "exif" not in image.info:
        return False
    try:
        return image.getexif().get_ifd(_INTEROPERABILITY).get(1) == "R03"
    except Exception:  # damaged EXIF data is no damage of the image
        return False


def _tiff(path: Path) -> tuple[bytes | None, bool]:
    """The profile in a TIFF file, and whether it is grey."""
    with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as content:
        header = read_tiff_header(content)
        if header.profile_at is None:
            return None, header.grey
        start, length = header.profile_at
        return content[start : start + min(length, MAX_BYTES + 1)], header.grey


def _exr_primaries(path: Path) -> Chromaticities | None:
    """The primaries that an OpenEXR file declares."""
    unreadable = partial(InputError, "The image cannot be read", where=path, fix="copy or write the file again")
    with open_file(path, unreadable) as file:
        start = file.read(4)
    return exr_primaries(path, unreadable) if is_exr(start) else None


def _is_srgb(profile: Profile) -> bool:
    ramp = np.linspace(0, 1, 256)
    same = all(np.abs(curve(ramp) - srgb_to_linear(ramp)).max() < _SAME for curve in profile.curves)
    return same and bool(np.abs(profile.primaries - np.eye(3)).max() < _SAME)


def _png(path: Path) -> Profile | bytes | None:
    """The profile of a PNG, that of its cICP chunk, or None for sRGB. Raises InputError or ValueError."""
    chunks: dict[bytes, bytes] = {}
    with path.open("rb") as file:
        file.seek(len(_PNG))
        while len(head := file.read(8)) == 8:
            length, kind = struct.unpack(">I4s", head)
            if kind in (b"IDAT", b"IEND"):
                break
            if kind in (b"iCCP", b"sRGB", b"gAMA", b"cHRM", b"cICP") and length <= MAX_BYTES:
                chunks[kind] = file.read(length)
                file.seek(4, 1)
            else:
                file.seek(length + 4, 1)
    if (code := chunks.get(b"cICP")) is not None:  # counts before all others
        return _of_code_points(code)
    if (packed := chunks.get(b"iCCP")) is not None:
        return _unpacked(packed.partition(b"\0")[2][1:])
    if b"sRGB" in chunks:
        return None
    gamma, white = chunks.get(b"gAMA"), chunks.get(b"cHRM")
    if gamma is not None and len(gamma) == 4:
        value = struct.unpack(">I", gamma)[0] / 1e5
        if not _SRGB_GAMMA[0] <= value <= _SRGB_GAMMA[1]:
            raise ValueError(f"a gAMA chunk of {value:g}, where sRGB has 0.45455")
    if white is not None and len(white) == 32:
        points = np.array(struct.unpack(">8I", white)) / 1e5
        if np.abs(points - _CHROMATICITIES).max() > 0.01:
            raise ValueError(f"a cHRM chunk of other primaries than sRGB's: {points.tolist()}")
    return None


def _of_code_points(code: bytes) -> Profile | None:
    """What a cICP chunk states [ITU-T H.273]. Raises ValueError."""
    names = {(1, 13): "srgb", (12, 13): "display_p3", (1, 8): "linear", (1, 1): "rec709"}
    name = names.get((code[0], code[1])) if len(code) == 4 and code[2:] == b"\0\1" else None
    if name is None:
        raise ValueError(f"a cICP chunk of {', '.join(map(str, code))}")
    if name == "srgb":
        return None
    stated = stated_conversion(Colour(encoding=name))
    return Profile(name=name, curves=(ENCODINGS[name].curve,) * 3, primaries=stated.primaries)


def _unpacked(packed: bytes) -> bytes:
    data = zlib.decompressobj().decompress(packed, MAX_BYTES + 1)
    if not data:
        raise ValueError("an empty profile")
    return data
