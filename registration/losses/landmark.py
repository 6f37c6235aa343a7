"""Landmark losses: the model's projected points against points detected in the images.

Landmarks whose spread nobody states are compared by `geman_mcclure` with one scale for all. Where a detector states its
own spread, or the model's scheme how well its points are known, `likelihood` weighs each point by it.
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from registration.types import Camera, Targets

_MIN_CONFIDENCE = 0.5
HEAD_PX = 512  # head height of residuals without a spread
UNKNOWN_PX = 3.0  # of a detection that states no spread, at 512 px of head height
_OUTLIER = 3.0  # standard deviations at which the pull of a landmark has fallen to a quarter of a Gaussian's


def project(cameras: tuple[Camera, ...], points: Float[Tensor, "L 3"]) -> Float[Tensor, "N L 2"]:
    """Return world points (metres) in the pixels of every camera; differentiable, without distortion."""

    def stack(values: list[np.ndarray]) -> Tensor:
        return torch.stack([torch.as_tensor(v) for v in values]).to(points)

    rotation = stack([c.T_cam_world[:3, :3] for c in cameras])
    shift = stack([c.T_cam_world[:3, 3] for c in cameras])
    intrinsics = stack([c.intrinsics for c in cameras])
    image = (points @ rotation.mT + shift[:, None]) @ intrinsics.mT
    return image[..., :2] / image[..., 2:]


def residuals(
    cameras: tuple[Camera, ...], points: Float[Tensor, "L 3"], detected: Float[Tensor, "N L 3"], px_per_head: float
) -> tuple[Float[Tensor, "N L"], Float[Tensor, "N L"]]:
    """Return the distances between projected and detected landmarks.

    Args:
        cameras: of the N views.
        points: of the model, world, metres.
        detected: x_px, y_px and confidence in each view.
        px_per_head: height of the head in the views, px.

    Returns:
        Distances, px at 512 px of head height; and 1 where the detection's confidence exceeds 0.5, else 0.
    """
    difference = project(cameras, points) - detected[..., :2]
    distance = (difference.square().sum(-1) + 1e-12).sqrt() * (512 / px_per_head)
    return distance, (detected[..., 2] > _MIN_CONFIDENCE).to(points)


def geman_mcclure(residual_px: Float[Tensor, "*S"], weight: Float[Tensor, "*S"], sigma_px: float) -> Float[Tensor, ""]:
    """Return the weighted mean of the Geman-McClure function r^2 / (r^2 + sigma^2) [Geman 1987].

    Quadratic below `sigma_px`, and 1 far above it, so that outliers do not pull.

    Args:
        residual_px: r, at 512 px of head height.
        weight: of each residual.
        sigma_px: where the function is one half.
    """
    squared = (residual_px / sigma_px).square()
    return (squared / (1 + squared) * weight).sum() / weight.sum().clamp_min(1.0)


@dataclass(frozen=True, kw_only=True, eq=False)
class Spread:
    """Standard deviations, along each axis, of the landmarks of a scheme in some views."""

    detections_px: Float[Tensor, "N L"]  # of each detection, independent of the others; px of the views
    scheme_m: Float[Tensor, "L"]  # of the scheme's points on the model, the same error in all views; metres

    @classmethod
    def of(cls, scheme: str, targets: Targets, scheme_m: Float[np.ndarray, "L"] | None) -> "Spread | None":
        """Return the spread of a scheme's landmarks in the views of some targets; None: nobody states it.

        Args:
            scheme: its name.
            targets: the views with their landmarks; one that states no spread has 3 px at 512 px of head height.
            scheme_m: of the scheme's points on the model, metres; None: it is exact.
        """
        stated, points = targets.landmark_spread_px.get(scheme), targets.landmarks[scheme]
        if stated is None and scheme_m is None:
            return None
        unknown = points.new_full(points.shape[:2], UNKNOWN_PX * targets.px_per_head / HEAD_PX)
        detections_px = unknown if stated is None else torch.where(stated.isnan(), unknown, stated)
        exact = np.zeros(points.shape[1])
        return cls(detections_px=detections_px, scheme_m=points.new_tensor(exact if scheme_m is None else scheme_m))

    def to(self, device: torch.device) -> "Spread":
        """Return the same on another device."""
        return Spread(detections_px=self.detections_px.to(device), scheme_m=self.scheme_m.to(device))

    def total_px(self, cameras: tuple[Camera, ...], points: Float[Tensor, "L 3"]) -> Float[Tensor, "N L"]:
        """Return the standard deviation of the projected points from their detections, px of the views.

        Args:
            cameras: of the views.
            points: of the model, world, metres.
        """
        return (self.detections_px.square() + (self.scheme_m * px_per_m(cameras, points)).square()).sqrt()

    def shares(
        self, cameras: tuple[Camera, ...], points: Float[Tensor, "L 3"], counted: Float[Tensor, "N L"]
    ) -> Float[Tensor, "L"]:
        """Return the factor of each detection's information that the scheme's own error leaves.

        N detections of standard deviation s determine a point whose place on the model is known to m with the
        information 1 / (m^2 + s^2 / N), not N / s^2: each counts 1 / (1 + m^2 N / s^2) of its own.

        Args:
            cameras: of all views of the capture.
            points: of the model, world, metres.
            counted: 1 where a detection counts, else 0.
        """
        information = (counted * (px_per_m(cameras, points) / self.detections_px).square()).sum(0)
        return 1 / (1 + self.scheme_m.square() * information)


def px_per_m(cameras: tuple[Camera, ...], points: Float[Tensor, "L 3"]) -> Float[Tensor, "N L"]:
    """Return by how many pixels a point moves in each view when it moves by a metre across the line of sight.

    Args:
        cameras: of the N views.
        points: world, metres; no gradient passes through.
    """
    points, scales = points.detach(), []
    for camera in cameras:
        depth = points @ points.new_tensor(camera.T_cam_world[2, :3]) + float(camera.T_cam_world[2, 3])
        focal_px = float(np.sqrt(camera.intrinsics[0, 0] * camera.intrinsics[1, 1]))
        scales.append(focal_px / depth.clamp_min(1e-3))
    return torch.stack(scales)


def likelihood(
    residual_px: Float[Tensor, "N L"],
    counted: Float[Tensor, "N L"],
    detections_px: Float[Tensor, "N L"],
    total_px: Float[Tensor, "N L"],
    shares: Float[Tensor, "L"],
) -> Float[Tensor, ""]:
    """Return the mean over the detections of twice their robust negative log likelihood.

    k (t / s)^2 rho(r / t) with rho(x) = x^2 / (1 + x^2 / 9): k (r / s)^2 for an inlier, bounded for an outlier
    [Geman 1987].

    Args:
        residual_px: r, px of the views.
        counted: 1 where a detection counts, else 0.
        detections_px: s, of `Spread`.
        total_px: t, of `Spread.total_px`.
        shares: k, of `Spread.shares`.
    """
    squared = (residual_px / total_px).square()
    information = shares * (total_px / detections_px).square()
    return (information * squared / (1 + squared / _OUTLIER**2) * counted).sum() / counted.sum().clamp_min(1.0)
