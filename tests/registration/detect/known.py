"""Faces of known points: a head-sized half ellipsoid, projected into cameras around its front."""

from pathlib import Path

import numpy as np
from jaxtyping import Float

from registration.detect.provider import Face
from registration.detect.views import ViewFaces
from registration.types import Camera, View
from tests.registration.capture.small import camera

YAWS_RAD = (-0.6, -0.3, 0.0, 0.3, 0.6)
NOISE = 0.004  # of detections, relative to the face's size


def cameras(yaws_rad: tuple[float, ...] = YAWS_RAD) -> list[Camera]:
    return [camera(yaw_rad, width_px=480, height_px=640) for yaw_rad in yaws_rad]


def head(seed: int = 0) -> Float[np.ndarray, "100 3"]:
    """Points on the front of a head of 14 x 18 x 9 cm, metres, without any symmetry."""
    rng = np.random.default_rng(seed)
    xy = rng.uniform(-0.65, 0.65, (100, 2))
    return np.column_stack([0.07 * xy[:, 0], 0.09 * xy[:, 1], 0.09 * np.sqrt(1 - (xy**2).sum(-1))])


def face(cam: Camera, points: Float[np.ndarray, "L 3"], seed: int = 0) -> Face:
    """The points as a detector finds them, with noise."""
    xy = cam.project(points)[0]
    spread = NOISE * float((xy.max(0) - xy.min(0)).max())
    xy = xy + np.random.default_rng(seed).normal(0, spread, xy.shape)
    return Face(
        points=xy,
        confidence=np.full(len(xy), 0.9),
        spread_px=np.full(len(xy), spread),
        presence=0.9,
        box=np.concatenate([xy.min(0), xy.max(0)]),
    )


def view(index: int, cam: Camera, *faces: Face) -> ViewFaces:
    stored = View(name=f"cam{index}", camera=cam, image=Path("unused.png"))
    return ViewFaces(view=stored, camera=cam, faces=faces)
