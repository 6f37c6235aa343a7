"""A sheet of stereo's maps: photograph, depth, normals and confidence of some views."""

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float, UInt8
from PIL import Image, ImageDraw, ImageFont

from registration.stereo.depth_map import DepthMap
from registration.stereo.views import StereoView, camera_image
from registration.storage.files import atomic_file

_TILE_PX, _CAPTION_PX, _GAP_PX = 240, 24, 6
_BACKGROUND, _INK = (24, 24, 28), (235, 235, 235)
_COLUMNS = ("photograph", "depth", "normals", "confidence")


def draw_sheet(
    names: Sequence[str],
    views: Sequence[StereoView],
    maps: Sequence[DepthMap | None],
    path: Path,
    rows: int = 6,
) -> None:
    """Write a PNG file with the maps of some views, evenly chosen.

    Args:
        names: of the views.
        views: the photographs.
        maps: of the views.
        path: the file; its folder exists.
        rows: views at most.
    """
    shown = [k for k, one in enumerate(maps) if one is not None]
    shown = [shown[k] for k in np.unique(np.linspace(0, len(shown) - 1, min(rows, len(shown))).astype(int))]
    tiles = [_tiles(views[k], maps[k]) for k in shown]
    heights = [tile[0].shape[0] + _CAPTION_PX for tile in tiles]
    width = len(_COLUMNS) * (_TILE_PX + _GAP_PX) + _GAP_PX
    page = Image.new("RGB", (width, sum(heights) + _GAP_PX), _BACKGROUND)
    pen, font, top = ImageDraw.Draw(page), ImageFont.load_default(14), 0
    for k, row, height in zip(shown, tiles, heights, strict=True):
        for column, (title, tile) in enumerate(zip(_COLUMNS, row, strict=True)):
            left = _GAP_PX + column * (_TILE_PX + _GAP_PX)
            pen.text((left, top + 4), names[k] if column == 0 else title, _INK, font)
            page.paste(Image.fromarray(tile), (left, top + _CAPTION_PX))
        top += height
    with atomic_file(path) as temporary:
        page.save(temporary, "PNG")


def _tiles(view: StereoView, depth_map: DepthMap | None) -> list[UInt8[np.ndarray, "h w 3"]]:
    assert depth_map is not None
    grey = camera_image(view, depth_map.camera).grey
    known = depth_map.depth > 0
    depth = np.zeros((*known.shape, 3), np.uint8)
    if known.any():
        low, high = np.percentile(depth_map.depth[known], [2, 98])
        share = np.clip((high - depth_map.depth) / max(high - low, 1e-6), 0, 1)
        depth = cv2.applyColorMap((255 * share).astype(np.uint8), cv2.COLORMAP_VIRIDIS)[..., ::-1].copy()
        depth[~known] = 0
    normals = np.where(known[..., None], 127.5 * (depth_map.normals * [1, -1, -1] + 1), 0)
    pictures = [_grey(grey), depth, normals, _grey(255 * depth_map.confidence)]
    height = round(_TILE_PX * known.shape[0] / known.shape[1])
    size = (_TILE_PX, height)
    return [cv2.resize(np.asarray(p, np.uint8), size, interpolation=cv2.INTER_AREA) for p in pictures]


def _grey(values: Float[np.ndarray, "h w"]) -> UInt8[np.ndarray, "h w 3"]:
    return np.repeat(np.clip(values, 0, 255).astype(np.uint8)[..., None], 3, -1)
