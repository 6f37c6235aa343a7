"""Priors on the free variables: coefficients, joints, eyeballs and offsets (losses/regularization.py)."""

from collections.abc import Mapping

from torch import Tensor

from registration.fit.terms.term import StageContext, StepState, Term
from registration.losses.regularization import gaussian_prior


def identity(context: StageContext) -> Term | None:
    """Gaussian prior on identity coefficients."""
    return _coefficients(context, "identity", context.stage.weights.identity)


def parts(context: StageContext) -> Term | None:
    """Gaussian prior on the identity coefficients that move no skin, where they alone are free."""
    weight, variables = context.stage.weights.parts, context.variables

    def term(state: StepState) -> Mapping[str, Tensor]:
        return {"parts": weight * gaussian_prior(variables.part_coefficients())}

    return term if context.stage.frees("parts") and len(variables["parts"]) else None


def expression(context: StageContext) -> Term | None:
    """Gaussian prior on expression coefficients."""
    return _coefficients(context, "expression", context.stage.weights.expression)


def joints(context: StageContext) -> Term | None:
    """Squared rotation angles of all joints but the root."""
    weight, variables = context.stage.weights.rotations, context.variables

    def term(state: StepState) -> Mapping[str, Tensor]:
        return {"joints": weight * variables["joints"].square().sum()}

    return term if context.stage.frees("joints") else None


def eyes(context: StageContext) -> Term | None:
    """Squared translations and scales of the eyeballs relative to the model."""
    weights, variables = context.stage.weights, context.variables

    def term(state: StepState) -> Mapping[str, Tensor]:
        translation, scale = variables["eyes"][:, :3], variables["eyes"][:, 3]
        return {"eyes": weights.eyes * translation.square().sum() + weights.eye_scale * scale.square().sum()}

    return term if context.stage.frees("eyes") else None


def offsets(context: StageContext) -> Term | None:
    """Size, stretch and bending of the free offsets, relative to those of the initial guess."""
    weight, variables, regularizer = context.stage.weights.offsets, context.variables, context.regularizer
    if regularizer is None:
        return None

    def term(state: StepState) -> Mapping[str, Tensor]:
        penalties = regularizer(state.skin_offsets - variables.reference_offsets)
        return {name: weight * penalty for name, penalty in penalties.items()}

    return term


def _coefficients(context: StageContext, name: str, weight: float) -> Term | None:
    variables = context.variables

    def term(state: StepState) -> Mapping[str, Tensor]:
        return {name: weight * gaussian_prior(variables[name])}

    return term if context.stage.frees(name) else None
