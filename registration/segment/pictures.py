"""Sheets of pictures that show masks and labels over the photographs, for a person to judge them."""

from collections.abc import Sequence

import cv2
import numpy as np
from jaxtyping import Bool, UInt8

from registration.capture.class_names import BACKGROUND, NECK
from registration.segment.fitted import BEARD, CLASSES, CLOTH, FOREIGN, GLASSES, HAIR, INDEX, UNLABELLED
from registration.segment.labels import Labelled
from registration.segment.views import SegmentView

COLOURS = {  # red green blue, of classes that are compared, and of those that are not: the latter are hatched
    "left_eye": (60, 120, 255),
    "right_eye": (0, 200, 230),
    "upper_lip": (255, 70, 130),
    "lower_lip": (190, 0, 90),
    "mouth_interior": (130, 0, 170),
    "ears": (255, 200, 0),
    NECK: (190, 130, 90),
    HAIR: (0, 190, 60),
    BEARD: (200, 140, 0),
    CLOTH: (60, 90, 220),
    GLASSES: (255, 255, 255),
    UNLABELLED: (150, 150, 150),
}
_LEGEND_PX, _TEXT = 22, 0.5
_SHADE = 0.45  # share of the class' colour in a pixel
_BACKGROUND = 0.35  # brightness of what is not the subject
_HATCH_PX = 8
_RIM = (255, 255, 255)


def overlay(image: UInt8[np.ndarray, "H W 3"], labelled: Labelled) -> UInt8[np.ndarray, "H W 3"]:
    """Return a photograph with its labels: the background dark, classes in colour, what is left out hatched.

    Args:
        image: of the view, red green blue.
        labelled: of the same size.
    """
    result = image.astype(np.float32)
    result[labelled.mask < 0.5] *= _BACKGROUND
    hatched = _hatch(labelled.labels.shape)
    for name, colour in COLOURS.items():
        region = labelled.labels == INDEX[name]
        if name in FOREIGN or name == UNLABELLED:
            region = region & hatched
        result[region] = (1 - _SHADE) * result[region] + _SHADE * np.array(colour, np.float32)
    edges = np.zeros(labelled.labels.shape, bool)
    for name in COLOURS:
        edges |= _rim(labelled.labels == INDEX[name])
    edges |= _rim(labelled.labels != INDEX[BACKGROUND])
    result[edges] = 0.4 * result[edges] + 0.6 * np.array(_RIM, np.float32)
    return result.clip(0, 255).astype(np.uint8)


def sheet(
    views: Sequence[SegmentView], labelled: Sequence[Labelled], *, columns: int = 4, tile_px: int = 400
) -> UInt8[np.ndarray, "H W 3"]:
    """Return one picture of some views with their labels, and a legend of the classes that occur.

    Args:
        views: at least one.
        labelled: of the same views.
        columns: how many tiles a row has at most.
        tile_px: height of a tile.
    """
    tiles = []
    for view, one in zip(views, labelled, strict=True):
        height, width = view.image.shape[:2]
        size = (max(1, round(width * tile_px / height)), tile_px)
        way = cv2.INTER_AREA if height > tile_px else cv2.INTER_LINEAR
        tile = cv2.resize(overlay(view.image, one), size, interpolation=way)
        _write(tile, view.name, (6, 18), thickness=3, grey=0)
        _write(tile, view.name, (6, 18))
        tiles.append(tile)
    columns = min(columns, len(tiles))
    width = max(tile.shape[1] for tile in tiles)
    tiles = [np.pad(tile, ((0, 4), (0, width - tile.shape[1] + 4), (0, 0))) for tile in tiles]
    tiles += [np.zeros_like(tiles[0])] * (-len(tiles) % columns)
    rows = [np.hstack(tiles[first : first + columns]) for first in range(0, len(tiles), columns)]
    picture = np.vstack(rows)
    shown = set(np.unique(np.concatenate([np.unique(one.labels) for one in labelled])).tolist())
    names = [name for name in CLASSES if name in COLOURS and INDEX[name] in shown]
    return np.vstack([picture, _legend(names, picture.shape[1])])


def _legend(names: Sequence[str], width: int) -> UInt8[np.ndarray, "H W 3"]:
    """Colours and names in as many lines as they need; what is left out of the comparison says so."""
    texts = [f"{name} (left out)" if name in FOREIGN or name == UNLABELLED else name for name in names]
    places, x, line = [], 6, 0
    for text in texts:
        needed = 26 + cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, _TEXT, 1)[0][0] + 14
        if x + needed > width and x > 6:
            x, line = 6, line + 1
        places.append((x, line))
        x += needed
    legend = np.full(((line + 1) * _LEGEND_PX + 6, width, 3), 24, np.uint8)
    for name, text, (left, row) in zip(names, texts, places, strict=True):
        top = 5 + row * _LEGEND_PX
        patch = legend[top : top + 14, left : left + 20]
        patch[_hatch(patch.shape[:2]) if text != name else np.ones(patch.shape[:2], bool)] = COLOURS[name]
        _write(legend, text, (left + 26, top + 12))
    return legend


def _write(
    picture: UInt8[np.ndarray, "H W 3"], text: str, place: tuple[int, int], thickness: int = 1, grey: int = 255
) -> None:
    cv2.putText(picture, text, place, cv2.FONT_HERSHEY_SIMPLEX, _TEXT, (grey,) * 3, thickness, cv2.LINE_AA)


def _hatch(shape: tuple[int, ...]) -> Bool[np.ndarray, "H W"]:
    y, x = np.ogrid[: shape[0], : shape[1]]
    return np.asarray((x + y) % _HATCH_PX < _HATCH_PX * 0.6)


def _rim(region: Bool[np.ndarray, "H W"]) -> Bool[np.ndarray, "H W"]:
    return np.asarray(region & (cv2.erode(region.astype(np.uint8), np.ones((3, 3), np.uint8)) == 0))
