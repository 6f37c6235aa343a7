"""OpenEXR images: their size by the header alone, and their pixels."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

from registration.errors import InputError
from registration.storage.image_files import MAX_PIXELS, too_many_pixels
from registration.storage.reading import Refuse, open_file

if TYPE_CHECKING:
    import numpy as np

_MAGIC = b"\x76\x2f\x31\x01"
_COLOURS = (("R", "G", "B"), ("Y",))  # channels that are read together, the first that are all there
_DEPTHS = (("Z",), ("Depth.Z",), ("ViewLayer.Depth.Z",), ("V",), ("Y",), ("R",))  # as renderers name them


def is_exr(start: bytes) -> bool:
    """Return whether a file that starts with these bytes is an OpenEXR file."""
    return start[:4] == _MAGIC


def exr_size(file: Path, refuse: Refuse, *, depth: bool = False) -> tuple[int, int]:
    """Return the width and height (px) that an OpenEXR file declares, of an image or of a depth map.

    Raises:
        InputError: it is missing, damaged, has more than `MAX_PIXELS`, several parts, samples in depth, a data window
            that is not its display window, or no channels R, G and B, or Y (of a depth map: Z, V, Y or R).
    """
    header = _header(file, refuse)
    try:
        names = {channel.name: channel for channel in header["channels"]}
    except UnicodeDecodeError as error:
        raise refuse(expected="names of channels in ASCII", got=str(error)) from None
    read = _read_channels(names, _DEPTHS if depth else _COLOURS)
    if not read or any((names[name].xSampling, names[name].ySampling) != (1, 1) for name in read):
        expected = f"channels {'Z, V, Y or R' if depth else 'R, G, B or Y'} at full resolution"
        raise refuse(expected=expected, got=", ".join(names) or "no channels")
    low, high = header["dataWindow"]
    if any((a != b).any() for a, b in zip(header["dataWindow"], header["displayWindow"], strict=True)):
        raise refuse(expected="a data window that is the display window", got=f"{low} to {high}")
    if "deep" in str(header.get("type", "")):
        raise refuse(expected="one sample a pixel", got="deep data")
    width_px, height_px = (int(b) - int(a) + 1 for a, b in zip(low, high, strict=True))
    if width_px * height_px > MAX_PIXELS:
        raise too_many_pixels(file, f"{width_px} x {height_px}")
    return width_px, height_px


def exr_primaries(file: Path, refuse: Refuse) -> tuple[tuple[float, float], ...] | None:
    """Return x and y of the red, green, blue and white that an OpenEXR file declares; None: it declares none.

    Raises:
        InputError: it is missing or damaged.
    """
    given = _header(file, refuse).get("chromaticities")
    if given is None:
        return None
    numbers = [float(value) for value in given]
    return tuple(zip(numbers[::2], numbers[1::2], strict=True))


def read_exr(file: Path, refuse: Refuse) -> "np.ndarray":
    """Return the pixels as (H, W, 3) float32, grey repeated. Check its size first.

    Raises:
        InputError: they cannot be decoded, or are no half or float numbers.
    """
    import numpy as np

    planes = _planes(file, refuse, _COLOURS)
    return np.stack(planes if len(planes) == 3 else planes * 3, -1)


def read_exr_depth(file: Path, refuse: Refuse) -> "np.ndarray":
    """Return a depth map as (H, W) float32. Check its size first.

    Raises:
        InputError: as `read_exr`.
    """
    return _planes(file, refuse, _DEPTHS)[0]


def write_exr_depth(file: Path, depth: "np.ndarray") -> None:
    """Write a depth map (H, W) as 32 bit numbers, channel Z, compressed without loss."""
    import numpy as np
    import OpenEXR

    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    OpenEXR.File(header, {"Z": np.ascontiguousarray(depth, np.float32)}).write(str(file))


def _planes(file: Path, refuse: Refuse, sets: tuple[tuple[str, ...], ...]) -> "list[np.ndarray]":
    import numpy as np
    import OpenEXR

    try:
        with OpenEXR.File(str(file), separate_channels=True) as image:
            if not image.parts:  # the library prints why
                raise refuse(expected="a whole, undamaged image", got="pixels that cannot be decoded")
            channels = image.channels()
            planes = [np.asarray(channels[name].pixels) for name in _read_channels(channels, sets)]
    except InputError:
        raise
    except Exception as error:  # the library raises its own kinds
        raise refuse(expected="a whole, undamaged image", got=str(error)) from None
    if any(plane.dtype not in (np.float16, np.float32) for plane in planes):
        raise refuse(expected="half or float", got=", ".join(str(plane.dtype) for plane in planes))
    return [plane.astype(np.float32) for plane in planes]


def _read_channels(names: Any, sets: tuple[tuple[str, ...], ...]) -> tuple[str, ...]:
    return next((wanted for wanted in sets if set(wanted) <= set(names)), ())


def _header(file: Path, refuse: Refuse) -> dict[str, Any]:
    import OpenEXR

    open_file(file, refuse).close()  # it is a regular file
    try:
        with OpenEXR.File(str(file), separate_channels=True, header_only=True) as image:
            if len(image.parts) != 1:
                raise refuse(expected="one part", got=f"{len(image.parts)} parts")
            return dict(image.header())
    except (RuntimeError, TypeError, ValueError) as error:
        raise refuse(expected="a whole OpenEXR file", got=str(error)) from None
