"""Sliding of an expression along its own skin: the neutral's texture against the images (losses/uv_ssim.py)."""

from collections.abc import Mapping
from dataclasses import replace

from torch import Tensor

from registration.fit.terms.term import StageContext, StepState, Term


def sliding(context: StageContext) -> Term | None:
    """Dissimilarity in texture space, only for an expression whose neutral is registered."""
    weight = context.stage.weights.slide
    uv_ssim = context.fit.uv_ssim if weight > 0 else None
    if uv_ssim is None:
        return None

    def term(state: StepState) -> Mapping[str, Tensor]:
        colours = context.appearance.corrected(state.batch, state.views)
        return {"slide": weight * uv_ssim(state.vertices, replace(state.batch, rgb=colours))}

    return term
