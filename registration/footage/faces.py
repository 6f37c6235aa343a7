"""Faces in decoded images: searched, cached by the content of the pixels, and one of several chosen."""

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8

from registration.capture.triangulation import MIN_CONFIDENCE
from registration.detect import face_cache
from registration.detect.faces import face_region, face_size
from registration.detect.provider import Face, FollowingProvider, LandmarkProvider
from registration.detect.search import FaceSearch, plausible
from registration.errors import InputError

_CODE = 1  # raised when the same provider gives other results here
_NEAR = 1.0  # distance from the face before, relative to its size, up to which a face is the same one
Pixels = UInt8[np.ndarray, "_ _ 3"]


@dataclass(frozen=True, kw_only=True, eq=False)
class FoundFaces:
    """The faces of one image, the largest first, and those that were refused as uncertain."""

    faces: tuple[Face, ...]
    how: str  # "upright", "turned" or "tiles": the search that found them, or the last one


class CachedFaces:
    """Searches decoded images with a provider; each result is kept by the content of the pixels.

    Args:
        provider: of landmarks.
        cache: folder of results; None: nothing is kept.
    """

    def __init__(self, provider: LandmarkProvider, cache: Path | None) -> None:
        self.provider = provider
        self._search, self._cache = FaceSearch(provider=provider), cache

    def search(self, pixels: Pixels, *, thorough: bool = True) -> FoundFaces:
        """Return the faces of an image.

        Args:
            pixels: sRGB.
            thorough: search turned copies and tiles, too, if there is no upright face.
        """
        ways = {"upright": self._search.upright, "turned": self._search.turned, "tiles": self._search.tiled}
        how = ""
        for how, find in ways.items():
            if faces := self._cached(pixels, f"{how} still", find):
                return FoundFaces(faces=tuple(sorted(faces, key=face_size, reverse=True)), how=how)
            if not thorough:
                break
        return FoundFaces(faces=(), how=how)

    def follow(self, pixels: Pixels, before: Face) -> Face | None:
        """Return the face that was `before` in the last frame, or None if it is lost."""
        region = face_region(before)
        key = f"{np.round(region.centre, 2).tolist()} {region.side:.2f} {region.roll:.4f}"

        def find(image: Pixels) -> Sequence[Face]:
            if isinstance(self.provider, FollowingProvider):
                followed = self.provider.follow(image, before)
                return () if followed is None else (followed,)
            return self._search.in_region(image, region)

        faces = self._cached(pixels, f"follow {key}", find)
        if not faces:
            faces = self.search(pixels, thorough=False).faces
        return nearest(faces, before)

    def _cached(self, pixels: Pixels, how: str, find: Callable[[Pixels], Sequence[Face]]) -> tuple[Face, ...]:
        if self._cache is None:
            return plausible(find(pixels))
        digest = hashlib.sha256(np.ascontiguousarray(pixels).tobytes()).hexdigest()
        decides = (_CODE, self.provider.scheme, self.provider.version, pixels.shape, digest, how)
        file = self._cache / f"{hashlib.sha256(repr(decides).encode()).hexdigest()}.npz"
        faces = face_cache.read(file, self.provider.count)
        if faces is None:
            faces = plausible(find(pixels))
            face_cache.write(file, faces)
        return faces


def nearest(faces: Sequence[Face], before: Face, *, anywhere: bool = False) -> Face | None:
    """Return the face whose place and size are most like those before; None if all are elsewhere.

    Args:
        faces: of an image.
        before: the face in the last image that shows it.
        anywhere: a face counts however far away it is.
    """
    size, centre = face_size(before), before.points.mean(0)

    def distance(face: Face) -> float:
        moved = float(np.linalg.norm(face.points.mean(0) - centre)) / size
        return moved + abs(float(np.log(face_size(face) / size)))

    best = min(faces, key=distance, default=None)
    return best if best is not None and (anywhere or distance(best) < _NEAR) else None


def choose(faces: Sequence[Face], number: int | None, where: object) -> tuple[Face, str]:
    """Return one of the faces of an image, and a note if there are several.

    Args:
        faces: at least one, the largest first.
        number: 1 for the largest; None: the largest.
        where: of the image, for messages.

    Raises:
        InputError: there are fewer faces.
    """
    index = 0 if number is None else number - 1
    if index >= len(faces):
        raise InputError(
            "There is no such face",
            where=where,
            expected=f"--face 1 to {len(faces)}, by size",
            got=number,
            fix="choose another one, or the largest without --face",
        )
    if len(faces) == 1:
        return faces[0], ""
    x0, y0, x1, y1 = faces[index].box
    place = f"at {x0:.0f} to {x1:.0f}, {y0:.0f} to {y1:.0f} px"
    which = "the largest" if index == 0 else f"number {index + 1} by size"
    return faces[index], f"{where}: {len(faces)} faces; {which} is fitted, {place}; --face N chooses another"


def observed(face: Face) -> tuple[Float[np.ndarray, "L 2"], Float[np.ndarray, "L"]]:
    """Return the points that the camera sees, NaN for others, and their standard deviations, px."""
    seen = face.confidence > MIN_CONFIDENCE
    return np.where(seen[:, None], face.points, np.nan), np.maximum(face.spread_px, 1e-3)
