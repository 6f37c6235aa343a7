"""What the pixels of a mask file mean: the subject is bright in grey values or opaque in an alpha channel."""

from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Shaped, UInt8

from registration.errors import InputError

_HALF = 128
_FULL = 253  # of 255: above 0.99, from where on a pixel counts as inside
_COLOURLESS = 8  # difference between channels that compression leaves in grey
_FIX = "write one channel of 8 bits, 255 where the subject is and 0 elsewhere"


def subject_coverage(path: Path, pixels: Shaped[np.ndarray, "H W *C"]) -> UInt8[np.ndarray, "H W"]:
    """Return the coverage by the subject, 255 = covered; all 0 for an empty mask.

    A mask is grey, or in two colours of which one is black, or has an alpha channel that is not the same everywhere. A
    mask whose subject is brighter than half but not white, as mattes end at 245 or 200, is scaled to 255.

    Args:
        path: of the file, for messages.
        pixels: as decoded, in 8 or 16 bits, with any number of channels; alpha is the last of two or four.

    Raises:
        InputError: the pixels are no mask; says why.
    """
    if pixels.dtype not in (np.uint8, np.uint16):
        raise _refuse(path, "8 or 16 bits", f"values of type {pixels.dtype}")
    pixels = pixels if pixels.ndim == 3 else pixels[..., None]
    colours, alpha = pixels[..., :3], None
    if pixels.shape[2] in (2, 4):
        colours, alpha = pixels[..., :-1], pixels[..., -1]
        alpha = None if alpha.min() == alpha.max() else _eight_bits(path, np.ascontiguousarray(alpha), "alpha channel")
    if alpha is None:
        return _full_range(path, _grey(path, colours))
    if _is_constant(colours) or _is_coloured(colours):
        return _full_range(path, alpha)
    grey = _eight_bits(path, np.ascontiguousarray(colours[..., 0]), "grey values")
    middle = ((grey > 25) & (grey < 230)).mean()
    if middle > 0.05:  # a picture, cut out by its alpha channel
        return _full_range(path, alpha)
    if ((grey >= _HALF) != (alpha >= _HALF)).mean() > 0.001:
        raise _refuse(path, "grey values or an alpha channel", "both, and they differ")
    return _full_range(path, grey)


def _grey(path: Path, colours: Shaped[np.ndarray, "H W C"]) -> UInt8[np.ndarray, "H W"]:
    if not _is_coloured(colours):
        return _eight_bits(path, np.ascontiguousarray(colours[..., 0]), "grey values")
    brightest = colours.max(-1)
    lit = colours[brightest > 0]
    if len(lit) and (lit == lit[0]).all():
        return np.where(brightest > 0, 255, 0).astype(np.uint8)
    raise _refuse(path, "grey, or black and one other colour", "several colours: a picture or a map of labels")


def _eight_bits(path: Path, values: Shaped[np.ndarray, "H W"], what: str) -> UInt8[np.ndarray, "H W"]:
    if values.dtype == np.uint8:
        return values
    brightest = int(values.max())
    if 0 < brightest < 256:
        got = f"16 bits, but no value above {brightest} of 65535 in the {what}"
        raise _refuse(path, "65535 where the subject is, in 16 bits", got)
    return np.round(values / 257).astype(np.uint8)


def _full_range(path: Path, values: UInt8[np.ndarray, "H W"]) -> UInt8[np.ndarray, "H W"]:
    """Scale so that the subject is at 255, unless it is there or too dark."""
    counts = cv2.calcHist([values], [0], None, [256], [0, 256]).ravel()
    bright = counts[_HALF:]
    if not bright.sum():
        if darkest := int(np.flatnonzero(counts)[-1]):
            raise _refuse(path, "255 where the subject is", f"no pixel above {darkest}", what="The mask is too dark")
        return values
    # A quarter of the subject may be a soft rim.
    level = _HALF + int(np.searchsorted(bright.cumsum(), 0.25 * bright.sum()))
    inside, between = counts[int(0.9 * level) :].sum(), counts[int(0.1 * level) : int(0.9 * level)].sum()
    if between > inside:
        share = between / (between + inside)
        raise _refuse(
            path, "pixels that are bright or dark", f"{share:.0%} in between: a picture, or a very soft matte"
        )
    if level >= _FULL:
        return values
    return cv2.LUT(values, np.minimum(np.round(np.arange(256) * (255 / level)), 255).astype(np.uint8))


def _is_constant(colours: Shaped[np.ndarray, "H W C"]) -> bool:
    return bool((colours == colours[:1, :1]).all())


def _is_coloured(colours: Shaped[np.ndarray, "H W C"]) -> bool:
    if colours.shape[2] == 1:
        return False
    limit = _COLOURLESS * (257 if colours.dtype == np.uint16 else 1)
    first = np.ascontiguousarray(colours[..., 0])
    return any(cv2.absdiff(first, np.ascontiguousarray(colours[..., i])).max() > limit for i in (1, 2))


def _refuse(path: Path, expected: str, got: str, what: str = "The mask cannot be used") -> InputError:
    return InputError(what, where=path, expected=expected, got=got, fix=_FIX)
