"""Landmarks: projected points of the model against those detected in the images (losses/landmark.py)."""

from collections.abc import Mapping

import torch
from torch import Tensor

from registration.fit.terms.term import StageContext, StepState, Term
from registration.losses import landmark


def landmarks(context: StageContext) -> Term | None:
    """One loss for each landmark scheme that model and capture share."""
    weights, schemes = context.stage.weights, context.fit.captured_schemes
    used = {name: torch.as_tensor(context.landmarks_used[name], device=context.fit.device) for name in schemes}

    def term(state: StepState) -> Mapping[str, Tensor]:
        losses = {}
        for name, scheme in schemes.items():
            points, detected = scheme.points(state.vertices), state.batch.landmarks[name]
            cameras, px_per_head = state.batch.pixels.cameras, state.batch.px_per_head
            residual_px, counted = landmark.residuals(cameras, points, detected, px_per_head)
            loss = landmark.geman_mcclure(residual_px, counted * used[name], weights.landmark_sigma_px)
            losses[f"landmarks {name}"] = weights.landmarks * loss
        return losses

    return term if weights.landmarks > 0 and schemes else None
