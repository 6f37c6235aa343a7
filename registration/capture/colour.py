"""What the values of an image mean: from a file's encoding to sRGB, as `View.colour` and the file say.

An image that is sRGB already is not touched. All others become 16 bit sRGB, so that whoever reads an image has to know
one encoding only: decode with the transfer function, convert to sRGB's primaries, apply the camera's matrix and gain.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, Shaped, UInt16

from registration.errors import InputError
from registration.frames import linear_to_srgb, srgb_to_linear
from registration.types import Colour

Curve = Callable[[np.ndarray], np.ndarray]  # of code values in [0, 1], to linear light
Chromaticities = tuple[tuple[float, float], ...]  # red, green, blue, white: CIE 1931 x, y
_D65 = (0.3127, 0.3290)
_REC709: Chromaticities = ((0.64, 0.33), (0.30, 0.60), (0.15, 0.06), _D65)
_BRADFORD = np.array([[0.8951, 0.2664, -0.1614], [-0.7502, 1.7135, 0.0367], [0.0389, -0.0685, 1.0296]])
_ROWS = 256  # converted at a time
_MOST = 0.5  # share of an image above 1 at which its gain must be wrong


@dataclass(frozen=True, kw_only=True)
class Encoding:
    """A transfer function and the primaries that belong to it."""

    curve: Curve
    primaries: Chromaticities = _REC709
    linear: bool = False  # floating-point files hold it


def _piecewise(x: np.ndarray, cut: float, low: Curve, high: Curve) -> np.ndarray:
    return np.where(x < cut, low(x), high(np.maximum(x, cut)))


def _linear(x: np.ndarray) -> np.ndarray:
    return x


def _rec709(x: np.ndarray) -> np.ndarray:
    """ITU-R BT.709-6, inverse of the camera's curve, with BT.2020's digits of its constants: without a step."""
    a, b = 1.09929682680944, 0.018053968510807
    return _piecewise(x, 4.5 * b, lambda v: v / 4.5, lambda v: ((v + a - 1) / a) ** (1 / 0.45))


def _adobe_rgb(x: np.ndarray) -> np.ndarray:
    """Adobe RGB (1998) Color Image Encoding: gamma 563 / 256."""
    return np.maximum(x, 0) ** (563 / 256)


def _logc3(x: np.ndarray) -> np.ndarray:
    """ARRI LogC3, exposure index 800 [ARRI LogC Curve, Usage in VFX, 2017]."""
    a, b, c, d, e, f, cut = 5.555556, 0.052272, 0.247190, 0.385537, 5.367655, 0.092809, 0.010591
    return _piecewise(x, e * cut + f, lambda v: (v - f) / e, lambda v: (10 ** ((v - d) / c) - b) / a)


def _logc4(x: np.ndarray) -> np.ndarray:
    """ARRI LogC4 [ARRI LogC4 Logarithmic Color Space Specification, 2022]."""
    a, b, c = (2**18 - 16) / 117.45, (1023 - 95) / 1023, 95 / 1023
    s = 7 * np.log(2) * 2 ** (7 - 14 * c / b) / (a * b)
    t = (2 ** (14 * -c / b + 6) - 64) / a
    return _piecewise(x, 0.0, lambda v: v * s + t, lambda v: (2 ** (14 * (v - c) / b + 6) - 64) / a)


def _slog3(x: np.ndarray) -> np.ndarray:
    """Sony S-Log3 [Technical Summary for S-Gamut3.Cine/S-Log3 and S-Gamut3/S-Log3]."""
    knee = 171.2102946929
    return _piecewise(
        x,
        knee / 1023,
        lambda v: (v * 1023 - 95) * 0.01125 / (knee - 95),
        lambda v: 10 ** ((v * 1023 - 420) / 261.5) * 0.19 - 0.01,
    )


def _canon_log3(x: np.ndarray) -> np.ndarray:
    """Canon Log 3, code values; 0.9 is the reflection of its unit [Canon Log Gamma Curves, 2018]."""
    scale, step = 14.98325, 0.36726845
    middle = _piecewise(
        x,
        0.15277891,
        lambda v: (v - 0.12512219) / 1.9754798,
        lambda v: (10 ** ((v - 0.12240537) / step) - 1) / scale,
    )
    return 0.9 * np.where(x < 0.097465473, -(10 ** ((0.12783901 - np.minimum(x, 0.1)) / step) - 1) / scale, middle)


def _vlog(x: np.ndarray) -> np.ndarray:
    """Panasonic V-Log [V-Log/V-Gamut Reference Manual, 2014]."""
    b, c, d = 0.00873, 0.241514, 0.598206
    return _piecewise(x, 0.181, lambda v: (v - 0.125) / 5.6, lambda v: 10 ** ((v - d) / c) - b)


def _film_gen5(x: np.ndarray) -> np.ndarray:
    """Blackmagic Film, generation 5 [Blackmagic Generation 5 Color Science, 2021]."""
    a, b, c = 0.08692876065491224, 0.005494072432257808, 0.5300133392291939
    d, e = 8.283605932402494, 0.09246575342465753
    return _piecewise(x, d * 0.005 + e, lambda v: (v - e) / d, lambda v: np.exp((v - c) / a) - b)


def _log3g10(x: np.ndarray) -> np.ndarray:
    """RED Log3G10 [White Paper on REDWideGamutRGB and Log3G10, 2017]."""
    a, b, c, g = 0.224282, 155.975327, 0.01, 15.1927
    return _piecewise(x, 0.0, lambda v: v / g - c, lambda v: (10 ** (v / a) - 1) / b - c)


ENCODINGS: Mapping[str, Encoding] = {
    "srgb": Encoding(curve=srgb_to_linear),
    "linear": Encoding(curve=_linear, linear=True),
    "acescg": Encoding(
        curve=_linear, primaries=((0.713, 0.293), (0.165, 0.83), (0.128, 0.044), (0.32168, 0.33767)), linear=True
    ),
    "rec709": Encoding(curve=_rec709),
    "display_p3": Encoding(curve=srgb_to_linear, primaries=((0.68, 0.32), (0.265, 0.69), (0.15, 0.06), _D65)),
    "adobe_rgb": Encoding(curve=_adobe_rgb, primaries=((0.64, 0.33), (0.21, 0.71), (0.15, 0.06), _D65)),
    "arri_logc3": Encoding(
        curve=_logc3, primaries=((0.684, 0.313), (0.221, 0.848), (0.0861, -0.102), _D65)
    ),  # ARRI Wide Gamut 3
    "arri_logc4": Encoding(curve=_logc4, primaries=((0.7347, 0.2653), (0.1424, 0.8576), (0.0991, -0.0308), _D65)),
    "sony_slog3": Encoding(curve=_slog3, primaries=((0.73, 0.28), (0.14, 0.855), (0.1, -0.05), _D65)),  # S-Gamut3
    "sony_slog3_cine": Encoding(curve=_slog3, primaries=((0.766, 0.275), (0.225, 0.8), (0.089, -0.087), _D65)),
    "canon_log3": Encoding(
        curve=_canon_log3, primaries=((0.74, 0.27), (0.17, 1.14), (0.08, -0.1), _D65)
    ),  # Cinema Gamut
    "panasonic_vlog": Encoding(curve=_vlog, primaries=((0.73, 0.28), (0.165, 0.84), (0.1, -0.03), _D65)),
    "blackmagic_film5": Encoding(
        curve=_film_gen5,
        primaries=((0.7177215, 0.3171181), (0.228041, 0.861569), (0.1005841, -0.0820452), (0.312717, 0.3290312)),
    ),
    "red_log3g10": Encoding(
        curve=_log3g10, primaries=((0.780308, 0.304253), (0.121595, 1.493994), (0.095612, -0.084589), _D65)
    ),
}


def to_rec709(primaries: Chromaticities) -> Float[np.ndarray, "3 3"]:
    """Return the matrix from linear light in some primaries to linear sRGB; white stays white, by Bradford."""
    white = _xyz(primaries[3])
    cones, ours = _BRADFORD @ white, _BRADFORD @ _xyz(_D65)
    adapted = np.linalg.inv(_BRADFORD) @ np.diag(ours / cones) @ _BRADFORD
    return np.linalg.inv(_to_xyz(_REC709)) @ adapted @ _to_xyz(primaries)


def _to_xyz(primaries: Chromaticities) -> Float[np.ndarray, "3 3"]:
    columns = np.stack([_xyz(xy) for xy in primaries[:3]], 1)
    return columns * np.linalg.solve(columns, _xyz(primaries[3]))


def _xyz(xy: tuple[float, float]) -> Float[np.ndarray, "3"]:
    x, y = xy
    return np.array([x / y, 1, (1 - x - y) / y])


@dataclass(frozen=True, kw_only=True)
class Conversion:
    """How the values of an image become sRGB."""

    name: str  # of the encoding or the profile
    curves: tuple[Curve, Curve, Curve]
    primaries: Float[np.ndarray, "3 3"]  # to linear sRGB
    colour: Colour  # its matrix and gain

    def to_srgb(self, path: Path, pixels: Shaped[np.ndarray, "H W 3"]) -> UInt16[np.ndarray, "H W 3"]:
        """Return 16 bit sRGB; light below 0 and above 1 is clipped, as a camera does.

        Args:
            path: of the file, for messages.
            pixels: as decoded, 8 or 16 bits or float32.

        Raises:
            InputError: the light is not finite, or most of it is above 1.
        """
        top = np.float32(1 if pixels.dtype.kind == "f" else np.iinfo(pixels.dtype).max)
        result = np.empty(pixels.shape, np.uint16)
        above, brightest = 0, []
        for first in range(0, len(pixels), _ROWS):
            light = self._light(pixels[first : first + _ROWS].astype(np.float32) / top)
            if not np.isfinite(light).all():
                raise InputError(
                    "The image's light is not finite",
                    where=path,
                    expected="numbers",
                    got=f"NaN or infinity at {int((~np.isfinite(light)).any(-1).sum())} pixels or more",
                    fix="write the image again",
                )
            peak = light.max(-1)
            above += int((peak > 1).sum())
            brightest.append(np.median(peak))
            result[first : first + _ROWS] = np.round(linear_to_srgb(light) * 65535).astype(np.uint16)
        if above > _MOST * pixels.shape[0] * pixels.shape[1]:
            gain = self.colour.gain * 0.5 / float(np.median(brightest))
            raise InputError(
                "Most of the image is brighter than 1",
                where=path,
                expected="linear light whose white is at 1",
                got=f"more at {100 * above / (pixels.shape[0] * pixels.shape[1]):.0f} % of the pixels",
                fix=f"write gain = {gain:.3g} in [colour] of capture.toml",
            )
        return result

    def _light(self, values: Float[np.ndarray, "R W 3"]) -> Float[np.ndarray, "R W 3"]:
        """Linear sRGB of some rows."""
        matrix = None if self.colour.matrix is None else np.array(self.colour.matrix, np.float32)
        if matrix is not None and self.colour.matrix_space == "encoded":
            values = _affine(matrix, values)
        light = np.stack([curve(values[..., k]) for k, curve in enumerate(self.curves)], -1)
        light = light @ self.primaries.T.astype(np.float32)
        if matrix is not None and self.colour.matrix_space == "linear":
            light = _affine(matrix, light)
        return (light * self.colour.gain).astype(np.float32)


def _affine(matrix: Float[np.ndarray, "3 C"], values: Float[np.ndarray, "R W 3"]) -> Float[np.ndarray, "R W 3"]:
    moved = values @ matrix[:, :3].T
    return moved if matrix.shape[1] == 3 else moved + matrix[:, 3]


def stated_conversion(colour: Colour, primaries: Chromaticities | None = None) -> Conversion:
    """Return the conversion that a view's colour states.

    Args:
        colour: its encoding is one of `ENCODINGS`.
        primaries: of the file, in place of the encoding's.
    """
    encoding = ENCODINGS[colour.encoding]
    return Conversion(
        name=colour.encoding,
        curves=(encoding.curve,) * 3,
        primaries=to_rec709(primaries or encoding.primaries),
        colour=colour,
    )


def require_encoding(path: Path, colour: Colour) -> None:
    """Refuse a floating-point image unless the capture says that it holds linear light. Raises InputError."""
    if not ENCODINGS[colour.encoding].linear:
        raise InputError(
            "The image holds floating-point numbers",
            where=path,
            expected='linear light, and encoding = "linear" or "acescg" in [colour] of capture.toml',
            got=f'floating-point numbers, and encoding = "{colour.encoding}"',
            fix='write encoding = "linear" in [colour] of capture.toml if they are linear light; else convert the image'
            " to 8 or 16 bit sRGB",
        )
