"""Where figures are taken: the face ball, and what the cameras see (docs/formats.md, "Figures")."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from registration.capture.triangulation import triangulate
from registration.errors import InputError
from registration.geometry.rasterizer import RayCaster
from registration.types import Camera, Capture, Registration

SCHEME = "68"
NOSE_BRIDGE, NOSE_BASE, RIGHT_EYE, LEFT_EYE = 27, 33, 36, 45  # of the scheme; outer corners of the eyes


@dataclass(frozen=True, kw_only=True)
class FaceBall:
    """The ball that holds the face; metres, capture world."""

    centre: Float[np.ndarray, "3"]
    radius: float
    landmarks: str  # where the landmarks came from: "capture" or "registration"

    def holds(self, points: Float[np.ndarray, "P 3"]) -> Bool[np.ndarray, "P"]:
        return np.linalg.norm(points - self.centre, axis=1) <= self.radius


def face_ball(capture: Capture, registration: Registration) -> FaceBall:
    """The ball from the capture's triangulated landmarks, else from the registration's own.

    Raises:
        InputError: neither has the four landmarks that define it.
    """
    fitted = registration.landmarks.get(SCHEME, np.zeros((0, 3)))
    for source, points in (("capture", triangulate(capture, SCHEME)[0]), ("registration", fitted)):
        if len(points) == 68:
            bridge, base, right, left = np.asarray(points[[NOSE_BRIDGE, NOSE_BASE, RIGHT_EYE, LEFT_EYE]], np.float64)
            radius = 1.4 * (np.linalg.norm(right - left) + np.linalg.norm(bridge - base)) / 2
            if np.isfinite(radius) and radius > 0:
                return FaceBall(centre=base + 0.3 * (bridge - base), radius=float(radius), landmarks=source)
    raise InputError(
        "The face cannot be found",
        where=f"{capture.root} and its registration",
        expected=f'landmarks {NOSE_BRIDGE}, {NOSE_BASE}, {RIGHT_EYE}, {LEFT_EYE} of scheme "{SCHEME}" in two views',
        got="too few, and none stored with the registration",
        fix=f"add landmarks, or register with a model that has head_sparse_{SCHEME}.txt beside it",
    )


def seen(
    points: Float[np.ndarray, "P 3"],
    vertices: Float[np.ndarray, "V 3"],
    triangles: Int[np.ndarray, "F 3"],
    cameras: Sequence[Camera],
    tolerance: float = 5e-4,
) -> Bool[np.ndarray, "P"]:
    """Which points at least two cameras see past a mesh; world frame, metres."""
    count = np.zeros(len(points), int)
    mesh = RayCaster(vertices, triangles)
    for camera in cameras:
        count += mesh.visible(points, camera, tolerance)
    return count >= 2
