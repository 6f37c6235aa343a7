"""The mesh against the depth maps of the views (losses/depth.py)."""

from collections.abc import Mapping

from torch import Tensor

from registration.fit.terms.term import StageContext, StepState, Term
from registration.frames import MM_PER_M
from registration.losses.depth import robust


def depth(context: StageContext) -> Term | None:
    """Distance of the skin from the depths of a step's views, if the capture has any."""
    weights, fit = context.stage.weights, context.fit
    if fit.pyramid[0].depth is None or not weights.depth > 0:
        return None
    scale_m = weights.depth_scale_mm / MM_PER_M

    def term(state: StepState) -> Mapping[str, Tensor]:
        _, distance, weight = fit.depth_distances(state.vertices, state.rendered, state.batch, state.agree)
        return {"depth": weights.depth * robust(distance, weight, state.batch, scale_m)}

    return term
