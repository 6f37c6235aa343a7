"""Landmarks: projected points of the model against those detected in the images (losses/landmark.py)."""

from collections.abc import Mapping

import torch
from jaxtyping import Float, Int
from torch import Tensor

from registration.fit.terms.term import StageContext, StepState, Term
from registration.geometry.topology import vertex_normals
from registration.losses import landmark
from registration.losses.landmark import Spread
from registration.model.landmarks import LandmarkScheme


def landmarks(context: StageContext) -> Term | None:
    """One loss for each landmark scheme that model and capture share: a likelihood where spreads are known."""
    weights = context.stage.weights
    schemes = {name: scheme for name, scheme in context.fit.captured_schemes.items() if _weight(context, scheme) > 0}
    used = {name: torch.as_tensor(context.landmarks_used[name], device=context.fit.device) for name in schemes}
    along_skin = weights.landmarks_along_skin and context.stage.frees("offsets")
    triangles = torch.as_tensor(context.fit.data.triangles.astype("int64"), device=context.fit.device)
    shares: dict[str, Float[Tensor, L]] = {}

    def term(state: StepState) -> Mapping[str, Tensor]:
        losses = {}
        for name, scheme in schemes.items():
            points, detected = scheme.points(state.vertices), state.batch.landmarks[name]
            cameras, px_per_head = state.batch.pixels.cameras, state.batch.px_per_head
            spread = Spread.of(name, state.batch, scheme.spread_m)
            if spread is None:
                residual_px, counted = landmark.residuals(cameras, points, detected, px_per_head)
                loss = landmark.geman_mcclure(residual_px, counted * used[name], weights.landmark_sigma_px)
                losses[f"landmarks {name}"] = weights.landmarks * loss
                continue
            if name not in shares:
                shares[name] = _shares(context, name, points)
            if along_skin:
                points = scheme.points(_along_skin(state.vertices, triangles))
            residual_px, counted = landmark.residuals(cameras, points, detected, landmark.HEAD_PX)
            total_px = spread.total_px(cameras, points)
            loss = landmark.likelihood(residual_px, counted * used[name], spread.detections_px, total_px, shares[name])
            losses[f"landmarks {name}"] = weights.landmark_likelihood * loss
        return losses

    return term if schemes else None


def _weight(context: StageContext, scheme: LandmarkScheme) -> float:
    """The weight of a scheme's landmarks in the stage."""
    weights, known = context.stage.weights, Spread.of(scheme.name, context.fit.pyramid[0], scheme.spread_m)
    return weights.landmarks if known is None else weights.landmark_likelihood


def _shares(context: StageContext, name: str, points: Float[Tensor, "L 3"]) -> Float[Tensor, "L"]:
    """`Spread.shares` over all views of the capture."""
    fit = context.fit
    targets = fit.pyramid[0]
    spread = Spread.of(name, targets, fit.schemes[name].spread_m)
    assert spread is not None
    cameras, points = targets.pixels.cameras, points.detach()
    counted = landmark.residuals(cameras, points, targets.landmarks[name].to(points), landmark.HEAD_PX)[1]
    return spread.to(points.device).shares(cameras, points, counted)


def _along_skin(vertices: Float[Tensor, "V 3"], triangles: Int[Tensor, "F 3"]) -> Float[Tensor, "V 3"]:
    """The same vertices, with gradients in the surface's tangent plane only."""
    fixed = vertices.detach()
    normals = vertex_normals(fixed, triangles)
    motion = vertices - fixed
    return fixed + motion - (motion * normals).sum(-1, keepdim=True) * normals
