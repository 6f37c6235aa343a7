"""The loss terms of a fit. A new one is a factory in a module of this package and a line in `TERMS`."""

from registration.fit.terms import contacts, depth, folds, image, landmarks, priors, scan, sliding
from registration.fit.terms.term import StageContext, StepState, Term, TermFactory

__all__ = ["TERMS", "StageContext", "StepState", "Term", "TermFactory", "make_terms"]

TERMS: tuple[TermFactory, ...] = (
    image.normals,
    image.mask,
    image.classes,
    image.colour,
    landmarks.landmarks,
    contacts.contacts,
    folds.folds,
    sliding.sliding,
    scan.scan,
    depth.depth,
    priors.identity,
    priors.parts,
    priors.expression,
    priors.joints,
    priors.eyes,
    priors.offsets,
)


def make_terms(context: StageContext) -> tuple[Term, ...]:
    """Return the terms of a stage, in the order of `TERMS`.

    Args:
        context: of the stage; its variables are free already.
    """
    return tuple(term for factory in TERMS if (term := factory(context)) is not None)
