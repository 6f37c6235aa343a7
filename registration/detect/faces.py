"""Sizes, regions and doubles of detected faces."""

from collections.abc import Sequence

import numpy as np

from registration.detect.crops import Crop
from registration.detect.provider import Face

_SAME = 0.4  # distance of two faces' centres, relative to the size of one, below which they are one face


def face_size(face: Face) -> float:
    """Return the longer side of the box around a face's points, px."""
    return float((face.points.max(0) - face.points.min(0)).max())


def face_region(face: Face) -> Crop:
    """Return the square around a face, upright at its turn."""
    return Crop.around(face.points, face.roll, 1.0)


def distinct(faces: Sequence[Face]) -> list[Face]:
    """Return the faces, the most certain first, without those in the middle of a more certain one."""
    kept: list[Face] = []
    for face in sorted(faces, key=lambda face: -face.presence):
        centre = face.points.mean(0)
        if all(np.linalg.norm(centre - other.points.mean(0)) > _SAME * face_size(other) for other in kept):
            kept.append(face)
    return kept
