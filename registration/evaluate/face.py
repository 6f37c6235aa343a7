"""Where a registration is measured: the face sphere, and what the cameras see (docs/formats.md, "Figures")."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from registration.capture.triangulation import triangulate
from registration.errors import InputError
from registration.geometry.rasterizer import RayCaster
from registration.types import Camera, Capture, Registration

SCHEME = "68"
NOSE_BRIDGE, NOSE_BASE, RIGHT_EYE, LEFT_EYE = 27, 33, 36, 45  # landmarks of the scheme; outer eye corners


@dataclass(frozen=True, kw_only=True)
class FaceSphere:
    """The sphere that bounds the face; metres, capture world."""

    centre: Float[np.ndarray, "3"]
    radius: float
    landmarks: str  # their source: "capture" or "registration"

    def contains(self, points: Float[np.ndarray, "P 3"]) -> Bool[np.ndarray, "P"]:
        """Return which points lie in the sphere, its surface included."""
        return np.linalg.norm(points - self.centre, axis=1) <= self.radius


def face_sphere(capture: Capture, registration: Registration) -> FaceSphere:
    """Return the face sphere, from the capture's triangulated landmarks or else from the registration's own.

    Its centre lies on the line from the base to the bridge of the nose, at 0.3 of its length. Its radius is 1.4 times
    the mean of this length and the distance between the outer eye corners.

    Args:
        capture: with landmarks of scheme 68, or without.
        registration: of the capture.

    Raises:
        InputError: neither has the four landmarks that define it.
    """
    fitted = registration.landmarks.get(SCHEME, np.zeros((0, 3)))
    for source, points in (("capture", triangulate(capture, SCHEME)[0]), ("registration", fitted)):
        if len(points) == 68:
            bridge, base, right, left = np.asarray(points[[NOSE_BRIDGE, NOSE_BASE, RIGHT_EYE, LEFT_EYE]], np.float64)
            radius = 1.4 * (np.linalg.norm(right - left) + np.linalg.norm(bridge - base)) / 2
            if np.isfinite(radius) and radius > 0:
                return FaceSphere(centre=base + 0.3 * (bridge - base), radius=float(radius), landmarks=source)
    raise InputError(
        "The face cannot be located",
        where=f"{capture.root} and its registration",
        expected=f'landmarks {NOSE_BRIDGE}, {NOSE_BASE}, {RIGHT_EYE}, {LEFT_EYE} of scheme "{SCHEME}" in two views',
        got="too few, and none stored with the registration",
        fix=f"add landmarks, or register with a model that has head_sparse_{SCHEME}.txt beside it",
    )


def visible_in_two_views(
    points: Float[np.ndarray, "P 3"],
    vertices: Float[np.ndarray, "V 3"],
    triangles: Int[np.ndarray, "F 3"],
    cameras: Sequence[Camera],
    tolerance: float = 5e-4,
) -> Bool[np.ndarray, "P"]:
    """Return which points at least two cameras see: in the image, and not occluded by a mesh.

    Args:
        points: metres, world.
        vertices: of the mesh that occludes points; metres, world.
        triangles: of the mesh.
        cameras: calibrated in the same world.
        tolerance: metres; a surface that is nearer to the camera than the point by less does not occlude it.
    """
    return views_of(points, vertices, triangles, cameras, tolerance)[0] >= 2


def views_of(
    points: Float[np.ndarray, "P 3"],
    vertices: Float[np.ndarray, "V 3"],
    triangles: Int[np.ndarray, "F 3"],
    cameras: Sequence[Camera],
    tolerance: float = 5e-4,
) -> tuple[Int[np.ndarray, "P"], Float[np.ndarray, "P 3"]]:
    """Return how many cameras see each point, and the sum of the unit directions from the point to these cameras.

    Arguments as of `visible_in_two_views`. The direction tells the outer side of a surface, however it is wound.
    """
    count, towards = np.zeros(len(points), int), np.zeros((len(points), 3))
    mesh = RayCaster(vertices, triangles)
    for camera in cameras:
        seen = np.flatnonzero(mesh.visible(points, camera, tolerance))
        count[seen] += 1
        direction = camera.centre - points[seen]
        towards[seen] += direction / np.linalg.norm(direction, axis=1, keepdims=True)
    return count, towards
