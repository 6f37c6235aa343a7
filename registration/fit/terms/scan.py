"""The surface of the capture's scan beside its pictures (losses/scan.py)."""

from collections.abc import Mapping

from torch import Tensor

from registration.fit.terms.term import StageContext, StepState, Term
from registration.frames import MM_PER_M

_ASSIGN_STEPS = 5  # after which planes are assigned anew


def scan(context: StageContext) -> Term | None:
    """Distance of the visible skin from the scan; only while offsets are free, and where a scan is to be fitted."""
    weights, distance = context.stage.weights, context.fit.scan_distance
    if distance is None or not weights.scan > 0:
        return None
    scale_m = weights.scan_scale_mm / MM_PER_M

    def term(state: StepState) -> Mapping[str, Tensor]:
        if state.step % _ASSIGN_STEPS == 0:
            distance.assign(state.vertices, scale_m)
        return {"scan": weights.scan * distance(state.vertices, scale_m)}

    return term
