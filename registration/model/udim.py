"""Texture coordinates with one UDIM tile for each part of the mesh, derived from those of the model file.

The file's `triangle_uvs` and `quad_uvs` have all parts in the unit square, where they overlap. In the UDIM convention
(as in the specification of UsdUVTexture) the integer part of a coordinate selects a tile, an image of its own; the tile
with its lower-left corner at (u, v) has the number 1001 + u + 10 v. Tiles 1001 to 1007 and their parts are those of the
official package's `triangle_uvs_udim`, so that textures can be exchanged with it.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import overload

import numpy as np
from jaxtyping import Bool, Float, Int

from registration.errors import InputError
from registration.geometry.texels import texels
from registration.model import regions
from registration.model.gnm_npz import GNMData

FIRST_TILE, TILES_PER_ROW = 1001, 10
_TEETH = 1006
_LOWER_TEETH = 1008  # if their uvs overlap those of the upper teeth; the official file interleaves both in 1006


@dataclass(frozen=True)
class Tile:
    """What a tile shows."""

    part: str  # unique
    material: str  # "skin", "eyes", "teeth" or "tongue": parts that a renderer shades alike


TILES: Mapping[int, Tile] = {
    1001: Tile("skin", "skin"),
    1002: Tile("left_eye_interior", "eyes"),  # sclera, iris and pupil
    1003: Tile("left_eye_exterior", "eyes"),  # the transparent outer shell with the cornea
    1004: Tile("right_eye_interior", "eyes"),
    1005: Tile("right_eye_exterior", "eyes"),
    _TEETH: Tile("teeth", "teeth"),  # with the gums
    1007: Tile("tongue", "tongue"),
    _LOWER_TEETH: Tile("lower_teeth", "teeth"),
}
_SIZE_PX = 512  # of the images in which overlaps are looked for
_OVERLAP = 0.01  # of the smaller part's texels: parts that merely touch share fewer
_TOLERANCE = 1e-5  # of a uv that lies on the border of its tile


@dataclass(frozen=True, kw_only=True, eq=False)
class UdimLayout:
    """UDIM texture coordinates of a model. The unit square of tile t begins at `tile_origin(t)`."""

    triangle_tiles: Int[np.ndarray, "F"]  # keys of `TILES`
    triangle_uvs: Float[np.ndarray, "F 3 2"]
    quad_tiles: Int[np.ndarray, "Q"]
    quad_uvs: Float[np.ndarray, "Q 4 2"]

    @property
    def tiles(self) -> tuple[int, ...]:
        """The tiles that have triangles, increasing."""
        return tuple(np.unique(self.triangle_tiles).tolist())


@overload
def tile_origin(tile: int) -> tuple[int, int]: ...
@overload
def tile_origin(tile: Int[np.ndarray, "N"]) -> tuple[Int[np.ndarray, "N"], Int[np.ndarray, "N"]]: ...
def tile_origin(tile: int | np.ndarray) -> tuple[int | np.ndarray, int | np.ndarray]:
    """Return u and v of the lower-left corner of a tile, or of each of an array of tiles."""
    return (tile - FIRST_TILE) % TILES_PER_ROW, (tile - FIRST_TILE) // TILES_PER_ROW


def udim_layout(data: GNMData) -> UdimLayout:
    """Return texture coordinates with each part of the mesh in a tile of its own.

    Coordinates differ from those of the file by whole numbers only; a file whose parts lie in tiles already gives the
    same result. A face of an eye belongs to the interior if all its corners are in the vertex group
    `eye_interiors`, else to the exterior. Upper and lower teeth share a tile unless they overlap in it.

    Args:
        data: the model.

    Returns:
        The layout, uvs in the file's floating-point type.

    Raises:
        InputError: the model lacks a vertex group, a vertex is in no component, or a part extends over several tiles.
    """
    faces = (data.triangles, data.quads)
    tiles = [_tiles(data, own) for own in faces]
    uvs = [data.triangle_uvs.copy(), data.quad_uvs.copy()]
    for tile in np.unique(np.concatenate(tiles)).tolist():
        members = [own == tile for own in tiles]
        low = _lower_left(tile, np.concatenate([uv[own].reshape(-1, 2) for uv, own in zip(uvs, members, strict=True)]))
        for uv, own in zip(uvs, members, strict=True):
            uv[own] -= low.astype(uv.dtype)
    if not _overlap(uvs[0], data.triangles, tiles[0] == _TEETH, tiles[0] == _LOWER_TEETH):
        tiles = [np.where(own == _LOWER_TEETH, _TEETH, own) for own in tiles]
    for uv, own in zip(uvs, tiles, strict=True):
        uv += np.stack(tile_origin(own), -1)[:, None].astype(uv.dtype)
    return UdimLayout(triangle_tiles=tiles[0], triangle_uvs=uvs[0], quad_tiles=tiles[1], quad_uvs=uvs[1])


def _lower_left(tile: int, corners: Float[np.ndarray, "N 2"]) -> Float[np.ndarray, "2"]:
    """The corner of the unit square that a part's uvs lie in. Raises InputError if there is none."""
    low: np.ndarray = np.floor(corners.min(0) + _TOLERANCE)
    if (corners > low + 1 + _TOLERANCE).any():
        raise InputError(
            f"The texture coordinates of the {TILES[tile].part.replace('_', ' ')} extend over several tiles",
            where="triangle_uvs, quad_uvs",
            expected="each part within one unit square",
            got=f"u, v from {corners.min(0).tolist()} to {corners.max(0).tolist()}",
            fix="use a model file whose parts have one map each",
        )
    return low


def _tiles(data: GNMData, faces: Int[np.ndarray, "N C"]) -> Int[np.ndarray, "N"]:
    """The tile of each face; upper and lower teeth apart."""
    numbers = {tile.part: number for number, tile in TILES.items()}
    interior = (regions.group(data, "eye_interiors") > 0.5)[faces].all(1)
    parts = {
        "skin": "skin",
        "upper_teeth_and_gums": "teeth",
        "lower_teeth_and_gums": "lower_teeth",
        "tongue": "tongue",
    }
    component = regions.components(data)[faces[:, 0]]
    tiles = np.zeros(len(faces), np.int64)
    for k, name in enumerate(data.mesh_component_names.tolist()):
        members = component == k
        if name in ("left_eye", "right_eye"):
            tiles[members & interior] = numbers[f"{name}_interior"]
            tiles[members & ~interior] = numbers[f"{name}_exterior"]
        elif name in parts:
            tiles[members] = numbers[parts[name]]
        elif members.any():
            expected = ", ".join(["left_eye", "right_eye", *parts])
            raise InputError(
                "A mesh component has no UDIM tile",
                where="mesh_component_names",
                expected=expected,
                got=name,
                fix="use a model file with the official components",
            )
    return tiles


def _overlap(
    uvs: Float[np.ndarray, "F 3 2"],
    triangles: Int[np.ndarray, "F 3"],
    a: Bool[np.ndarray, "F"],
    b: Bool[np.ndarray, "F"],
) -> bool:
    """Whether two sets of triangles show on the same texels."""
    if not (a.any() and b.any()):
        return False
    shown = [set(texels(triangles[own], uvs[own].astype(np.float64), _SIZE_PX).index.tolist()) for own in (a, b)]
    return len(shown[0] & shown[1]) > _OVERLAP * min(map(len, shown))
