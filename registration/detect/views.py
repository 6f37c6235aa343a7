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
from registration.detect.provider import Face, LandmarkProvider
from registration.detect.search import FaceSearch, plausible
from registration.storage.cache import cache_folder
from registration.storage.hashing import hash_fields, hash_file
from registration.types import Camera, View

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
        self._search = FaceSearch(provider=provider)
        self._cache = cache
        self._lock = threading.Lock()
        self._held: dict[Path, UInt8[np.ndarray, "H W 3"]] = {}
        self._digests: dict[Path, str] = {}

    def upright(self, view: View) -> ViewFaces:
        """Return the faces of the whole image."""
        return self._found(view, "upright", self._search.upright)

    def turned(self, view: View) -> ViewFaces:
        """Return the faces of the image turned by right angles and their halves, at the first turn with one."""
        return self._found(view, "turned", self._search.turned)

    def tiled(self, view: View) -> ViewFaces:
        """Return the faces of overlapping tiles of the image, of the largest tiles with one."""
        return self._found(view, "tiles", self._search.tiled)

    def in_region(self, view: View, region: Crop) -> ViewFaces:
        """Return the faces in a square of the undistorted image, about as large as the face and upright at its turn."""
        key = f"{np.round(region.centre, 3).tolist()} {region.side:.3f} {region.roll:.4f}"
        return self._found(view, f"region {key}", lambda image: self._search.in_region(image, region))

    def mirrored(self, view: View) -> ViewFaces:
        """Return the faces of the image with left and right exchanged, in pixels of that image."""
        return self._found(view, "mirrored", self._search.mirrored)

    def _found(self, view: View, how: str, find: Callable[[UInt8[np.ndarray, "H W 3"]], Sequence[Face]]) -> ViewFaces:
        camera = replace(view.camera, distortion=())
        file = None if self._cache is None else self._cache / f"{self._key(view, how)}.npz"
        faces = None if file is None else face_cache.read(file, self.provider.count)
        if faces is None:
            faces = plausible(find(self._photograph(view)))
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


def landmark_cache() -> Path:
    """Return the folder of cached landmarks, which may not exist yet."""
    return cache_folder() / "landmarks"
