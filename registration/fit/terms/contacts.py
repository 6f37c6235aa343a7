"""Contacts: intersections between parts of the head (losses/self_intersection.py)."""

from collections.abc import Mapping

from torch import Tensor

from registration.fit.terms.term import StageContext, StepState, Term
from registration.losses.self_intersection import OF_THE_TONGUE

_UPDATE_STEPS = 10  # after which the parts that may touch are determined again


def contacts(context: StageContext) -> Term | None:
    """One loss for each pair of parts; the pairs of the tongue have a weight of their own."""
    weights, variables = context.stage.weights, context.variables
    if not (weights.contacts or weights.tongue):
        return None
    penalty, identity_is_free = context.fit.self_intersection, context.stage.frees("identity")

    def term(state: StepState) -> Mapping[str, Tensor]:
        vertices = variables.contact_vertices(state.skin_offsets)
        if state.step % _UPDATE_STEPS == 0:
            if state.step == 0 or identity_is_free:  # else the bind pose is that of step 0
                # How the tongue fills the mouth in the bind pose is not observed; the model's own depths are accepted.
                penalty.set_rest_depths(variables.bind_pose_vertices(), OF_THE_TONGUE)
            penalty.update_candidates(vertices)
        return {
            f"contact {pair}": (weights.tongue if pair in OF_THE_TONGUE else weights.contacts) * loss
            for pair, loss in penalty(vertices).items()
        }

    return term
