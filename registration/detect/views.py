"""Faces in the views of a capture: upright, turned, in tiles, or in a given region; each image's result is cached."""

import hashlib
import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import UInt8

from registration.capture.pixels import read_photograph
from registration.detect import face_cache
from registration.detect.crops import Crop
from registration.detect.faces import distinct, face_region, face_size
from registration.detect.provider import Face, LandmarkProvider
from registration.storage.cache import cache_folder
from registration.storage.hashing import hash_fields, hash_file
from registration.types import Camera, View

_COARSE_PX = 1280  # longer side of the turned copies
_TURNS = tuple(np.radians([90.0, -90.0, 180.0, 45.0, -45.0]))
_TILES = (2, 4, 8, 16)  # per longer side of the image
_MIN_TILE_PX = 300
_OVERLAP = 0.3  # of neighbouring tiles: a face of this share of a tile lies in one whole
_REGION = 2.0  # side of a region, relative to the face's size
_MIN_REGION_PX, _MAX_REGION_PX = 256, 1024  # of its pixels
_MAX_SPREAD = 0.04  # median, relative to the face's size: false faces have 0.06, real ones up to 0.025 when blurred
_HELD_BYTES = 2**29  # of decoded photographs
_CODE = 1  # raised when the same provider gives other results here


@dataclass(frozen=True, kw_only=True, eq=False)
class ViewFaces:
    """The faces of one view, in pixels of its undistorted image, the most certain first."""

    view: View
    camera: Camera  # of the undistorted image
    faces: tuple[Face, ...]
    how: str = "upright"


class FaceFinder:
    """Runs a provider on views; may be used by several threads.

    Args:
        provider: the landmark provider.
        cache: folder of results, by the content of image, camera and provider; None: nothing is kept.
    """

    def __init__(self, provider: LandmarkProvider, cache: Path | None = None) -> None:
        self.provider = provider
        self._cache = cache
        self._lock = threading.Lock()
        self._held: dict[Path, UInt8[np.ndarray, "H W 3"]] = {}
        self._digests: dict[Path, str] = {}

    def upright(self, view: View) -> ViewFaces:
        """Return the faces of the whole image."""
        return self._found(view, "upright", self.provider.detect)

    def turned(self, view: View) -> ViewFaces:
        """Return the faces of the image turned by right angles and their halves, at the first turn with one."""

        def find(image: UInt8[np.ndarray, "H W 3"]) -> Sequence[Face]:
            whole = Crop.whole(image)
            for turn in _TURNS:
                slanted = abs(np.sin(2 * turn)) > 0.5  # then its corners reach farther
                crop = replace(whole, roll=turn, side=whole.side * (np.sqrt(2) if slanted else 1))
                size = round(min(crop.side, _COARSE_PX))
                if faces := self._in_crop(image, crop, size):
                    return self._refined(image, faces)
            return ()

        return self._found(view, "turned", find)

    def tiled(self, view: View) -> ViewFaces:
        """Return the faces of overlapping tiles of the image, of the largest tiles with one."""

        def find(image: UInt8[np.ndarray, "H W 3"]) -> Sequence[Face]:
            for count in _TILES:
                side = max(image.shape[:2]) / count
                if side < _MIN_TILE_PX:
                    break
                found = [face for tile in _tiles(image, side) for face in self._in_crop(image, tile, round(side))]
                if found:
                    return self._refined(image, distinct(found))
            return ()

        return self._found(view, "tiles", find)

    def in_region(self, view: View, region: Crop) -> ViewFaces:
        """Return the faces in a square of the undistorted image, about as large as the face and upright at its turn."""

        def find(image: UInt8[np.ndarray, "H W 3"]) -> Sequence[Face]:
            return self._in_crop(image, *_around(region))

        key = f"{np.round(region.centre, 3).tolist()} {region.side:.3f} {region.roll:.4f}"
        return self._found(view, f"region {key}", find)

    def mirrored(self, view: View) -> ViewFaces:
        """Return the faces of the image with left and right exchanged, in pixels of that image."""

        def find(image: UInt8[np.ndarray, "H W 3"]) -> Sequence[Face]:
            return self.provider.detect(np.ascontiguousarray(image[:, ::-1]))

        return self._found(view, "mirrored", find)

    def _found(self, view: View, how: str, find: Callable[[UInt8[np.ndarray, "H W 3"]], Sequence[Face]]) -> ViewFaces:
        camera = replace(view.camera, distortion=())
        file = None if self._cache is None else self._cache / f"{self._key(view, how)}.npz"
        faces = None if file is None else face_cache.read(file, self.provider.count)
        if faces is None:
            found = find(self._photograph(view))
            faces = tuple(face for face in found if np.median(face.spread_px) < _MAX_SPREAD * face_size(face))
            if file is not None:
                face_cache.write(file, faces)
        return ViewFaces(view=view, camera=camera, faces=faces, how=how.split()[0])

    def _key(self, view: View, how: str) -> str:
        with self._lock:
            digest = self._digests.get(view.image)
        if digest is None:
            digest = hash_file(view.image)
            with self._lock:
                self._digests[view.image] = digest
        lens = (view.camera.intrinsics.tolist(), view.camera.distortion) if view.camera.distortion else ()
        decides = (_CODE, self.provider.scheme, self.provider.version, digest, lens, hash_fields(view.colour), how)
        return hashlib.sha256(repr(decides).encode()).hexdigest()

    def _photograph(self, view: View) -> UInt8[np.ndarray, "H W 3"]:
        with self._lock:
            image = self._held.get(view.image)
        if image is None:
            image = read_photograph(view)[0]
            with self._lock:
                if sum(other.nbytes for other in self._held.values()) + image.nbytes < _HELD_BYTES:
                    self._held[view.image] = image
        return image

    def _in_crop(self, image: UInt8[np.ndarray, "H W 3"], crop: Crop, size: int) -> list[Face]:
        pixels = crop.pixels(image, size, black=True)
        return [_in_image(face, crop, size) for face in self.provider.detect(pixels)]

    def _refined(self, image: UInt8[np.ndarray, "H W 3"], faces: Sequence[Face]) -> list[Face]:
        """The faces detected again in upright crops of the image's own resolution; those that are lost are left out."""
        return distinct([again for face in faces for again in self._in_crop(image, *_around(face_region(face)))[:1]])


def landmark_cache() -> Path:
    """Return the folder of cached landmarks, which may not exist yet."""
    return cache_folder() / "landmarks"


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
