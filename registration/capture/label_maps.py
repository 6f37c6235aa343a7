"""Label maps: files of indices, or of the colours of a palette."""

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import UInt8
from PIL import Image

from registration.capture import label_order, label_tables
from registration.capture.class_names import UNLABELLED
from registration.capture.headers import Header, require_complete, require_size, undecodable
from registration.errors import InputError
from registration.storage.image_files import FORMATS, decode
from registration.types import Camera, Capture, LabelCode, View

_POSITIONS = LabelCode()
_MAX_STRAY = 1e-3  # share of pixels in no colour of the palette: a few clicks of a brush, not a resampled map
_GUESSED = 8  # maps that are read to guess a table
_ROWS = 512  # converted at a time
_FIX = "store the class index of each pixel in one 8 bit channel of a PNG"


def read_labels(
    path: Path, camera: Camera, classes: tuple[str, ...], code: LabelCode = _POSITIONS
) -> UInt8[np.ndarray, "H W"]:
    """Read a label map, distorted: positions in `classes`.

    Args:
        path: an image of indices in one channel of up to 8 bits, or of 8 bit colours.
        camera: its size.
        classes: of the capture.
        code: what the indices or colours stand for. A map in a PNG's palette is one of colours if the code has colours
            only, else of indices.

    Raises:
        InputError: the file is damaged, has another size, was compressed with loss or resampled, or has an index or a
            colour without a name.
    """
    header = require_size(path, "label map", camera.width_px, camera.height_px)
    require_complete(path, "label map")
    stored = read_stored(path, header, expand=bool(code.colours) and not code.indices)
    if stored.ndim == 3:
        return _of_colours(path, stored, classes, code)
    if code.colours and not code.indices:
        raise InputError(
            "The label map holds indices, and only colours have names",
            where=path,
            expected="8 bit RGB in the colours of the palette",
            got="one channel",
            fix="name the indices: table or classes of [segmentation] in capture.toml",
        )
    table = np.array(code.indices or range(len(classes)))
    named = np.append(table >= 0, np.zeros(256 - len(table), bool))
    counts = np.bincount(stored.ravel(), minlength=256)
    if (counts[~named] > 0).any():
        raise _unnamed(path, stored, counts, named, [classes[k] for k in table if k >= 0])
    if not code.indices:
        return stored
    return cv2.LUT(stored, np.append(table.clip(0), np.zeros(256 - len(table), int)).astype(np.uint8))


def read_stored(path: Path, header: Header, *, expand: bool = False) -> np.ndarray:
    """Read a label map as it is stored.

    Args:
        path: of the file.
        header: its own.
        expand: give the colours of a PNG's palette instead of its indices.

    Returns:
        (H, W) indices or (H, W, 3) RGB, uint8.

    Raises:
        InputError: it is damaged, or no map of indices or colours without loss.
    """
    refuse = undecodable(path, "label map")
    try:
        with Image.open(path, formats=FORMATS) as image:  # unlike OpenCV it does not convert palette indices to colours
            mode, form = image.mode, image.format
            plain = mode == "L" and header.png_bits == 8
            if plain:
                labels = decode(path, cv2.IMREAD_UNCHANGED, refuse)
            else:
                coloured = mode in ("RGB", "RGBA") or (mode == "P" and expand)
                labels = np.array(image.convert("RGB") if coloured else image)
    except InputError:
        raise
    except Exception as error:  # a damaged file makes Pillow raise nearly anything
        raise refuse(expected="a whole, undamaged image", got=f"{type(error).__name__}: {error}") from None
    if not plain:  # Pillow takes pixels that are missing for 0
        decode(path, cv2.IMREAD_UNCHANGED, refuse)
    if mode == "L" and header.png_bits in (2, 4):  # Pillow scales them to 8 bits
        labels = labels // (255 // (2**header.png_bits - 1))
    if form == "JPEG" or mode not in ("L", "P", "RGB", "RGBA") or labels.dtype != np.uint8 or header.png_bits == 16:
        lossy = "a JPEG, whose compression mixes indices and colours"
        raise InputError(
            "The label map is not a map of indices or colours",
            where=path,
            expected="8 bit, one channel or RGB, without loss",
            got=lossy if form == "JPEG" else f"mode {mode}, {header.png_bits or 8} bits",
            fix=_FIX,
        )
    return labels


def fitting_tables(views: Sequence[View]) -> list[str]:
    """Return the names of the tables that explain the label maps of some views, the likeliest first.

    Raises:
        InputError: as `read_stored`.
    """
    labelled = [(view, view.segmentation) for view in views if view.segmentation is not None]
    maps = []
    for view, path in labelled[:: -(-len(labelled) // _GUESSED) or 1]:
        header = require_size(path, "label map", view.camera.width_px, view.camera.height_px)
        maps.append(read_stored(path, header))
    coloured = [stored for stored in maps if stored.ndim == 3]
    if coloured:
        return [name for name in _tables_of(coloured[0]) if all(name in _tables_of(stored) for stored in coloured)]
    return [table.name for table in label_order.guess_order(maps)]


def renamed_classes(capture: Capture) -> list[str]:
    """Return a warning if classes of the capture have names of another vocabulary."""
    renamed = [f"{name} as {known}" for name, known in capture.labels.renamed]
    if not renamed:
        return []
    return [f"classes with other names are read so, left is the subject's: {', '.join(renamed)}"]


def _of_colours(
    path: Path, rgb: UInt8[np.ndarray, "H W 3"], classes: tuple[str, ...], code: LabelCode
) -> UInt8[np.ndarray, "H W"]:
    """Positions of colours; a few pixels in other colours are unlabelled."""
    if not code.colours:
        fits = _tables_of(rgb)
        raise InputError(
            "The label map is in colours, and no colour has a name",
            where=path,
            expected="the class index in one 8 bit channel, or RGB in the colours of a palette",
            got="mode RGB" + (f"; its colours are those of table {fits[0]}" if fits else ""),
            fix=f'write table = "{fits[0]}" in [segmentation] of capture.toml'
            if fits
            else f'name its colours in [segmentation.palette] of capture.toml, as skin = "#cc0000"; or {_FIX}',
        )
    stray = classes.index(UNLABELLED)
    table = np.full(2**24, 255, np.uint8)
    for red, green, blue, position in code.colours:
        table[red << 16 | green << 8 | blue] = position
    labels = np.empty(rgb.shape[:2], np.uint8)
    for first in range(0, len(rgb), _ROWS):
        block = rgb[first : first + _ROWS].astype(np.uint32)
        labels[first : first + _ROWS] = table[block[..., 0] << 16 | block[..., 1] << 8 | block[..., 2]]
    unknown = labels == 255
    count = int(unknown.sum())
    if count > _MAX_STRAY * labels.size:
        raise _strange(path, rgb[unknown], labels.size, code)
    labels[unknown] = stray
    return labels


def _strange(path: Path, unknown: UInt8[np.ndarray, "P 3"], size: int, code: LabelCode) -> InputError:
    """The error for pixels in no colour of the palette: colours that it lacks, or mixtures of its colours."""
    colours, counts = np.unique(unknown, axis=0, return_counts=True)
    common = [f"#{''.join(f'{int(v):02x}' for v in colours[k])} at {counts[k]} pixels" for k in np.argsort(-counts)[:4]]
    mixed = len(colours) > 2 * len(code.colours)
    got = f"{100 * len(unknown) / size:.2g} % of the pixels in {len(colours)} other colours: {', '.join(common)}"
    if mixed:
        fix = "write the map again without smoothing: nearest neighbour when it is scaled, PNG, no anti-aliased edges"
    else:
        fix = "name these colours in [segmentation.palette] of capture.toml"
    return InputError(
        "The label map has colours without a name" if not mixed else "The label map's colours are mixed",
        where=path,
        expected=f"the {len(code.colours)} colours of the palette, at all but {100 * _MAX_STRAY:.1g} % of the pixels",
        got=got,
        fix=fix,
    )


def _tables_of(rgb: UInt8[np.ndarray, "H W 3"]) -> list[str]:
    """Names of the tables that have all colours of a map."""
    sample = rgb[:: max(1, len(rgb) // 256), :: max(1, rgb.shape[1] // 256)].reshape(-1, 3)
    shown = {tuple(colour) for colour in np.unique(sample, axis=0).tolist()}
    return [table.name for table in label_tables.TABLES if len(shown) > 1 and shown <= set(table.colours)]


def _unnamed(
    path: Path, labels: UInt8[np.ndarray, "H W"], counts: np.ndarray, named: np.ndarray, names: Sequence[str]
) -> InputError:
    """The error for an index without a name; it names the table that explains the map."""
    highest = int(np.flatnonzero((counts > 0) & ~named).max())
    fits = label_order.guess_order([labels])
    fix = "name every index in [segmentation] classes of capture.toml; pixels to ignore (often 255) need one too"
    return InputError(
        "A label index has no name",
        where=path,
        expected=f"indices below {len(names)}: {', '.join(names)}" if named[: len(names)].all() else "named indices",
        got=f"index {highest} at {int(counts[highest])} pixels",
        fix=f'the map looks like {" or ".join(t.name for t in fits)}: write table = "{fits[0].name}" in place of '
        "[segmentation] classes of capture.toml"
        if fits
        else fix,
    )
