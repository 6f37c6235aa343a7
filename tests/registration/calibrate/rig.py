"""A rig of cameras around a cloud of points, with its observations."""

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from registration.calibrate.bundle import Observations, Priors, Rig, project

VIEWS, POINTS, FOCAL_PX = 8, 150, 1850.0


def rig(generator: np.random.Generator, *, deviation: float = 0.0, k1: float = 0.0) -> Rig:
    """Cameras 1.25 m from the origin, over 140 degrees of yaw, images of 480 x 720."""
    rotations = [
        (Rotation.from_euler("x", np.pi + generator.uniform(-0.4, 0.4)) * Rotation.from_euler("y", -yaw)).as_matrix()
        for yaw in np.linspace(-1.2, 1.2, VIEWS)
    ]
    spread = generator.normal(size=(VIEWS, 3)) * [0.02, 0.02, 0.05]
    return Rig(
        rotations=np.array(rotations),
        translations=spread + [0, 0, 1.25],
        centres_px=np.tile([240.0, 360.0], (VIEWS, 1)),
        group=np.zeros(VIEWS, np.int64),
        focals_px=np.array([FOCAL_PX]),
        k1=np.array([k1]),
        deviation=generator.normal(size=VIEWS) * deviation,
    )


def cloud(generator: np.random.Generator) -> np.ndarray:
    """Points of the size of a head."""
    return generator.normal(size=(POINTS, 3)) * [0.07, 0.1, 0.06]


def observations(
    truth: Rig, points: np.ndarray, generator: np.random.Generator, *, noise_px: float = 0.5, outliers: float = 0.0
) -> Observations:
    """Half of the points in each view, noisy, some of them off by up to 40 px."""
    seen = generator.random((VIEWS, len(points))) < 0.5
    seen[::3] |= seen.sum(0) < 3  # each in three views at least
    view, point = np.nonzero(seen)
    xy = project(truth, points, view, point) + generator.normal(size=(len(view), 2)) * noise_px
    wrong = generator.random(len(view)) < outliers
    xy[wrong] += generator.uniform(-40, 40, size=(int(wrong.sum()), 2))
    return Observations(view=view, point=point, xy_px=xy, sigma_px=np.full(len(view), noise_px))


def perturbed(truth: Rig, generator: np.random.Generator, focal_factor: float = 1.15) -> Rig:
    """Cameras turned by 2 degrees, moved by a centimetre, with another focal length and its distance."""
    turns = Rotation.from_rotvec(generator.normal(size=(VIEWS, 3)) * 0.03).as_matrix()
    translations = truth.translations * [1, 1, focal_factor] + generator.normal(size=(VIEWS, 3)) * 0.01
    return replace(
        truth,
        rotations=turns @ truth.rotations,
        translations=translations,
        focals_px=truth.focals_px * focal_factor,
        deviation=np.zeros(VIEWS),
        k1=np.zeros(1),
    )


def no_priors(points: np.ndarray, *, deviation_sigma: float = 0.0, k1_sigma: float = 0.0) -> Priors:
    """The focal length is unknown, and so is the gauge."""
    return Priors(
        points=points,
        point_sigma_m=np.full(len(points), np.inf),
        focals_px=np.array([FOCAL_PX]),
        focal_sigma=np.array([np.inf]),
        k1_sigma=k1_sigma,
        deviation_sigma=deviation_sigma,
    )
