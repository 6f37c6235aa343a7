"""Which points of a detected face the camera sees: those whose surface is turned towards it."""

import numpy as np
from jaxtyping import Float
from scipy.spatial import Delaunay

SKIN = 468  # the first points of `face478`; the others are the irises'
_RIGHT_EYE, _LEFT_EYE, _FOREHEAD, _CHIN = 33, 263, 10, 152
_HIDDEN, _SEEN = -0.2, 0.3  # cosines


def facing(points: Float[np.ndarray, "478 3"]) -> Float[np.ndarray, "478"]:
    """Return the cosine of the angle between the surface's normal and the direction to the camera at every point.

    The points, turned to the front, are connected by a Delaunay triangulation: a face is nearly a height field. The
    irises take the face's own direction.

    Args:
        points: x to the right, y down, z away from the camera, in one unit.
    """
    across = points[_LEFT_EYE] - points[_RIGHT_EYE]
    across = across / np.linalg.norm(across)
    down = points[_CHIN] - points[_FOREHEAD]
    down = down - (down @ across) * across
    frontal = np.stack([across, down / np.linalg.norm(down), np.zeros(3)])
    frontal[2] = np.cross(frontal[0], frontal[1])  # into the head
    turned = points[:SKIN] @ frontal.T
    triangles = Delaunay(turned[:, :2]).simplices
    corners = turned[triangles]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals *= np.sign(normals[:, 2:])  # into the head, too
    summed = np.zeros((len(points), 3))
    for corner in range(3):
        np.add.at(summed, triangles[:, corner], normals)
    summed[SKIN:] = [0.0, 0.0, 1.0]
    summed /= np.maximum(np.linalg.norm(summed, axis=-1, keepdims=True), 1e-12)
    return summed @ frontal[:, 2]


def seen(cosine: Float[np.ndarray, "L"]) -> Float[np.ndarray, "L"]:
    """Return whether points are seen, in [0, 1], from the cosines of `facing`: a half slightly before the contour.

    Measured on renders of heads: beyond it a point's error is several times that of others.
    """
    return np.clip((cosine - _HIDDEN) / (_SEEN - _HIDDEN), 0.0, 1.0)
