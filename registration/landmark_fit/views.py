"""Reprojection errors of one view and their derivatives."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from registration.landmark_fit.state import Layout

NEAR_M = 1e-3  # depth below which a point counts as behind the camera


@dataclass(frozen=True, kw_only=True, eq=False)
class ViewState:
    """A camera at one state."""

    rotation: Float[np.ndarray, "3 3"]  # camera from world
    translation: Float[np.ndarray, "3"]  # camera from world, metres
    focal_px: float
    k1: float
    principal_px: Float[np.ndarray, "2"]


@dataclass(frozen=True, kw_only=True, eq=False)
class ViewTerms:
    """Residuals over standard deviations of M landmarks, times the roots of their robust weights, and derivatives."""

    residual: Float[np.ndarray, "M 2"]
    by_world: Float[np.ndarray, "M 2 3"]
    by_log_focal: Float[np.ndarray, "M 2 1"]
    by_principal: Float[np.ndarray, "M 2 2"]
    by_k1: Float[np.ndarray, "M 2 1"]
    by_pose: Float[np.ndarray, "M 2 6"]  # a left rotation of R x, before the translation, and the translation

    def by_camera(self, layout: Layout, view: int, group: int) -> Iterator[tuple[int, np.ndarray]]:
        """First shared column, and derivatives by it and the following ones."""
        yield layout.shared("focal").start + group, self.by_log_focal
        yield layout.shared("principal").start + 2 * view, self.by_principal
        yield layout.shared("k1").start + group, self.by_k1
        yield layout.shared("poses").start + 6 * view, self.by_pose


def view_terms(
    world: Float[np.ndarray, "M 3"],
    points_px: Float[np.ndarray, "M 2"],
    sigma_px: Float[np.ndarray, "M"],
    camera: ViewState,
    weights: Callable[[np.ndarray], np.ndarray],
) -> ViewTerms:
    """Compare landmarks with their pixels.

    Args:
        world: metres.
        points_px: observed.
        sigma_px: standard deviations.
        camera: of the view.
        weights: robust weights of squared distances in standard deviations.
    """
    rotation, focal, k1 = camera.rotation, camera.focal_px, camera.k1
    turned = world @ rotation.T
    local = turned + camera.translation
    depth = np.where(np.abs(local[:, 2]) > NEAR_M, local[:, 2], NEAR_M)
    ray = local[:, :2] / depth[:, None]
    radius = (ray**2).sum(1)
    stretch = 1 + k1 * radius
    pixels = focal * stretch[:, None] * ray + camera.principal_px
    residual = (pixels - points_px) / sigma_px[:, None]
    weight = np.sqrt(weights((residual**2).sum(1))) * (local[:, 2] > NEAR_M)
    factor = weight / sigma_px
    # d (stretch * ray) / d ray, then d ray / d local.
    by_ray = stretch[:, None, None] * np.eye(2) + 2 * k1 * ray[:, :, None] * ray[:, None, :]
    ray_by_local = np.zeros((len(local), 2, 3))
    ray_by_local[:, 0, 0] = ray_by_local[:, 1, 1] = 1 / depth
    ray_by_local[:, :, 2] = -ray / depth[:, None]
    by_local = (focal * factor)[:, None, None] * (by_ray @ ray_by_local)
    by_rotation = np.cross(turned[:, None, :], by_local)  # by_local @ -[R x]x
    return ViewTerms(
        residual=residual * weight[:, None],
        by_world=by_local @ rotation,
        by_log_focal=(focal * factor * stretch)[:, None, None] * ray[..., None],
        by_principal=factor[:, None, None] * np.eye(2),
        by_k1=(focal * factor * radius)[:, None, None] * ray[..., None],
        by_pose=np.concatenate([by_rotation, by_local], 2),
    )
