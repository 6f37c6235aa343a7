"""ICC profiles of three curves and a matrix, as those of cameras' and displays' RGB spaces are [ICC.1:2022]."""

import struct
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

MAX_BYTES = 2**23  # of a profile
_SRGB_D50 = np.array(
    [[0.4360747, 0.3850649, 0.1430804], [0.2225045, 0.7168786, 0.0606169], [0.0139322, 0.0971045, 0.7141733]]
)
_MAX_TAGS = 256
_PARAMETERS = {0: 1, 1: 3, 2: 4, 3: 5, 4: 7}  # of each function type


@dataclass(frozen=True, kw_only=True)
class Profile:
    """From a device's values to linear sRGB."""

    name: str
    curves: tuple[Callable[[np.ndarray], np.ndarray], ...]  # three, of values in [0, 1]
    primaries: Float[np.ndarray, "3 3"]  # to linear sRGB


def parse_profile(data: bytes, *, grey: bool) -> Profile:
    """Read a profile.

    Args:
        data: of the profile.
        grey: the image has one channel; a grey image may have a profile of RGB, too.

    Raises:
        ValueError: it is damaged, of other colours (CMYK), or made of lookup tables; says so.
    """
    if len(data) < 132 or data[36:40] != b"acsp":
        raise ValueError("a damaged profile")
    space = data[16:20].decode("latin-1").strip()
    tags = _tags(data)
    name = _name(tags)
    if space == "GRAY" and grey and "kTRC" in tags:
        curve = _curve(tags["kTRC"])
        return Profile(name=name, curves=(curve,) * 3, primaries=np.eye(3))
    if space != "RGB":
        raise ValueError(f"{name}, of {space} colours")
    if "A2B0" in tags or not {"rXYZ", "gXYZ", "bXYZ", "rTRC", "gTRC", "bTRC"} <= set(tags):
        raise ValueError(f"{name}, made of lookup tables")
    columns = np.stack([_point(tags[f"{c}XYZ"]) for c in "rgb"], 1)
    curves = tuple(_curve(tags[f"{c}TRC"]) for c in "rgb")
    return Profile(name=name, curves=curves, primaries=np.linalg.inv(_SRGB_D50) @ columns)


def _tags(data: bytes) -> Mapping[str, bytes]:
    (count,) = struct.unpack_from(">I", data, 128)
    if count > _MAX_TAGS or 132 + 12 * count > len(data):
        raise ValueError("a damaged profile")
    tags = {}
    for k in range(count):
        kind, offset, size = struct.unpack_from(">4sII", data, 132 + 12 * k)
        if offset + size > len(data):
            raise ValueError("a truncated profile")
        tags[kind.decode("latin-1")] = data[offset : offset + size]
    return tags


def _name(tags: Mapping[str, bytes]) -> str:
    """The profile's description, in ASCII or UTF-16."""
    text = tags.get("desc", b"")
    if text[:4] == b"desc" and len(text) > 12:
        (length,) = struct.unpack_from(">I", text, 8)
        found = text[12 : 12 + min(length, 100)].decode("latin-1")
    elif text[:4] == b"mluc" and len(text) >= 28:
        length, offset = struct.unpack_from(">II", text, 20)
        found = text[offset : offset + min(length, 200)].decode("utf-16-be", "replace")
    else:
        found = ""
    return "".join(c for c in found if c.isprintable()).strip() or "a profile without a name"


def _point(tag: bytes) -> Float[np.ndarray, "3"]:
    if tag[:4] != b"XYZ " or len(tag) < 20:
        raise ValueError("a damaged profile")
    return np.array(struct.unpack_from(">3i", tag, 8)) / 65536


def _curve(tag: bytes) -> Callable[[np.ndarray], np.ndarray]:
    try:
        if tag[:4] == b"curv":
            return _sampled(tag)
        if tag[:4] == b"para":
            return _parametric(tag)
    except struct.error:
        pass
    raise ValueError("a damaged profile")


def _sampled(tag: bytes) -> Callable[[np.ndarray], np.ndarray]:
    (count,) = struct.unpack_from(">I", tag, 8)
    if count == 0:
        return lambda x: x
    values = np.array(struct.unpack_from(f">{count}H", tag, 12)) if 12 + 2 * count <= len(tag) else None
    if values is None:
        raise ValueError("a damaged profile")
    if count == 1:
        gamma = float(values[0]) / 256
        return lambda x: np.maximum(x, 0) ** gamma
    grid = np.linspace(0, 1, count)
    return lambda x: np.interp(x, grid, values / 65535).astype(np.float32)


def _parametric(tag: bytes) -> Callable[[np.ndarray], np.ndarray]:
    (kind,) = struct.unpack_from(">H", tag, 8)
    if kind not in _PARAMETERS:
        raise ValueError("a damaged profile")
    numbers = [v / 65536 for v in struct.unpack_from(f">{_PARAMETERS[kind]}i", tag, 12)]
    g, a, b, c, d, e, f = np.pad(numbers, (0, 7 - len(numbers))).tolist()
    if kind == 0:
        return lambda x: np.maximum(x, 0) ** g
    if kind < 3:  # constant below -b / a
        if a == 0:
            raise ValueError("a damaged profile")
        c, d, e, f = 0.0, -b / a, c, c
    return lambda x: np.where(x >= d, np.maximum(a * x + b, 0) ** g + e, c * x + f)
