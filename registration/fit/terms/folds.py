"""Folds of the outer skin (losses/folds.py)."""

from collections.abc import Mapping

from torch import Tensor

from registration.fit.terms.term import StageContext, StepState, Term


def folds(context: StageContext) -> Term | None:
    """Faces that turn against their neighbours; only while offsets are free, which alone fold the skin."""
    weight = context.stage.weights.folds
    if not weight > 0 or not context.stage.frees("offsets"):
        return None
    penalty = context.fit.folds

    def term(state: StepState) -> Mapping[str, Tensor]:
        return {"folds": weight * penalty(state.vertices)}

    return term
