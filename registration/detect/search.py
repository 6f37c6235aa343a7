"""Faces in one image: upright, turned, in tiles, in a given region, or mirrored."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import UInt8

from registration.detect.crops import Crop
from registration.detect.faces import distinct, face_region, face_size
from registration.detect.provider import Face, LandmarkProvider

Image = UInt8[np.ndarray, "H W 3"]

_COARSE_PX = 1280  # longer side of the turned copies
_TURNS = tuple(np.radians([90.0, -90.0, 180.0, 45.0, -45.0]))
_TILES = (2, 4, 8, 16)  # per longer side of the image
_MIN_TILE_PX = 300
_OVERLAP = 0.3  # of neighbouring tiles: a face of this share of a tile lies in one whole
_REGION = 2.0  # side of a region, relative to the face's size
_MIN_REGION_PX, _MAX_REGION_PX = 256, 1024  # of its pixels
_MAX_SPREAD = 0.04  # median, relative to the face's size: false faces have 0.06, real ones up to 0.025 when blurred


@dataclass(frozen=True, kw_only=True)
class FaceSearch:
    """Ways to search one image with a provider. Results are in pixels of the image, and may hold false faces."""

    provider: LandmarkProvider

    def upright(self, image: Image) -> Sequence[Face]:
        """Return the faces of the whole image."""
        return self.provider.detect(image)

    def turned(self, image: Image) -> Sequence[Face]:
        """Return the faces of the image turned by right angles and their halves, at the first turn with one."""
        whole = Crop.whole(image)
        for turn in _TURNS:
            slanted = abs(np.sin(2 * turn)) > 0.5  # then its corners reach farther
            crop = replace(whole, roll=turn, side=whole.side * (np.sqrt(2) if slanted else 1))
            size = round(min(crop.side, _COARSE_PX))
            if faces := self._in_crop(image, crop, size):
                return self._refined(image, faces)
        return ()

    def tiled(self, image: Image) -> Sequence[Face]:
        """Return the faces of overlapping tiles of the image, of the largest tiles with one."""
        for count in _TILES:
            side = max(image.shape[:2]) / count
            if side < _MIN_TILE_PX:
                break
            found = [face for tile in _tiles(image, side) for face in self._in_crop(image, tile, round(side))]
            if found:
                return self._refined(image, distinct(found))
        return ()

    def in_region(self, image: Image, region: Crop) -> Sequence[Face]:
        """Return the faces in a square of the image, about as large as the face and upright at its turn."""
        return self._in_crop(image, *_around(region))

    def mirrored(self, image: Image) -> Sequence[Face]:
        """Return the faces of the image with left and right exchanged, in pixels of that image."""
        return self.provider.detect(np.ascontiguousarray(image[:, ::-1]))

    def _in_crop(self, image: Image, crop: Crop, size: int) -> list[Face]:
        pixels = crop.pixels(image, size, black=True)
        return [_in_image(face, crop, size) for face in self.provider.detect(pixels)]

    def _refined(self, image: Image, faces: Sequence[Face]) -> list[Face]:
        """The faces detected again in upright crops of the image's own resolution; those that are lost are left out."""
        return distinct([again for face in faces for again in self._in_crop(image, *_around(face_region(face)))[:1]])


def plausible(faces: Sequence[Face]) -> tuple[Face, ...]:
    """Return the faces whose points are sure enough: not those that the net sees in a pattern."""
    return tuple(face for face in faces if np.median(face.spread_px) < _MAX_SPREAD * face_size(face))


def _around(region: Crop) -> tuple[Crop, int]:
    """The crop around a face's region, and its size in px."""
    crop = replace(region, side=region.side * _REGION)
    return crop, round(min(max(crop.side, _MIN_REGION_PX), _MAX_REGION_PX))


def _in_image(face: Face, crop: Crop, size: int) -> Face:
    """A face of a crop's pixels in pixels of the image."""
    points = crop.to_image(face.points / size)
    return replace(
        face,
        points=points,
        spread_px=face.spread_px * crop.side / size,
        box=np.concatenate([points.min(0), points.max(0)]),
        roll=float((face.roll + crop.roll + np.pi) % (2 * np.pi) - np.pi),
    )


def _tiles(image: UInt8[np.ndarray, "H W 3"], side: float) -> list[Crop]:
    height, width = image.shape[:2]
    xs, ys = (
        np.linspace(min(side, length) / 2, length - min(side, length) / 2, _steps(length, side))
        for length in (width, height)
    )
    return [Crop(centre=np.array([x, y]), side=side) for y in ys for x in xs]


def _steps(length: int, side: float) -> int:
    return 1 if length <= side else int(np.ceil((length - side) / (side * (1 - _OVERLAP)))) + 1
