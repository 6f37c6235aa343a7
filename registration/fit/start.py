"""Where a fit starts: from landmarks, the neutral, a given pose, or the masks."""

from dataclasses import replace
from functools import partial

import numpy as np
import torch

from registration.fit.context import FitContext
from registration.fit.initialization import (
    MIN_LANDMARKS,
    MIN_OVERLAP,
    UNKNOWN_SPREAD_M,
    from_landmarks,
    from_masks,
)
from registration.fit.landmark_start import refined
from registration.fit.problem import assess, refine
from registration.fit.variables import InitialGuess, initial_guess_from, pivot
from registration.model.landmarks import LandmarkScheme
from registration.types import HeadPose, Parameters, Registration


def initial_guess(context: FitContext, head: HeadPose | None = None) -> InitialGuess:
    """Return the initial guess of a fit.

    From landmarks, if model and capture share a scheme: in closed form from triangulated ones, then refined in the
    views, from linear equations where none are triangulated; else from the neutral's pose, if it covers the masks; else
    the given pose; else the best of many head poses at the masks' common centre.

    Args:
        context: its triangulated landmarks, neutral and masks are used.
        head: the pose that the capture brings, if any; in the world of the context.

    Returns:
        The guess; its notes say how it was estimated.

    Raises:
        InputError: no head pose covers the masks.
    """
    neutral = None
    if context.neutral is not None:
        parameters = _parameters(context.neutral)
        neutral = initial_guess_from(parameters, context.neutral.offsets, context.model, context.data)
    counts = {name: int(np.isfinite(points).all(1).sum()) for name, points in context.triangulated.items()}
    best = max(counts, key=lambda name: counts[name], default=None)
    if best is not None and counts[best] >= MIN_LANDMARKS:
        if any(context.landmark_spread_m(name) is not None for name in counts):
            closed = _from_all_schemes(context, neutral)
        else:
            scheme, points = context.schemes[best], context.triangulated[best]
            closed = from_landmarks(context.data, scheme, points, free_scale=context.recipe.scale, neutral=neutral)
        return _refined(context, closed, neutral) or closed
    alone = _refined(context, None, neutral)
    if alone is not None:
        return alone
    if neutral is not None and assess(context, neutral).overlap >= MIN_OVERLAP:
        return replace(neutral, notes=("no landmarks: starting from the neutral's pose",))
    if head is not None:
        position = head.scale * head.rotation @ pivot(context.data) + head.translation
        note = "no landmarks: starting from the head's pose in capture.toml"
        return InitialGuess(rotation=head.rotation, position=position, scale=head.scale, notes=(note,))
    return from_masks(context.data, context.pyramid[-1], partial(assess, context), partial(refine, context))


def _refined(context: FitContext, guess: InitialGuess | None, neutral: InitialGuess | None) -> InitialGuess | None:
    if context.seen_landmarks is None:
        return None
    return refined(context.data, context.seen_landmarks, guess, neutral=neutral, size=context.recipe.scale)


def _from_all_schemes(context: FitContext, neutral: InitialGuess | None) -> InitialGuess:
    """From the landmarks of all schemes together, each by its spread."""
    names = sorted(context.triangulated)
    schemes, points = [context.schemes[name] for name in names], [context.triangulated[name] for name in names]
    spreads = [context.landmark_spread_m(name) for name in names]
    together = LandmarkScheme(
        name=" + ".join(names),
        indices=np.concatenate([scheme.indices for scheme in schemes]),
        weights=np.concatenate([scheme.weights for scheme in schemes]),
    )
    guess = from_landmarks(
        context.data,
        together,
        np.concatenate(points),
        free_scale=context.recipe.scale,
        neutral=neutral,
        spread_m=np.concatenate(
            [np.full(len(p), UNKNOWN_SPREAD_M) if s is None else s for s, p in zip(spreads, points, strict=True)]
        ),
    )
    used = np.split(guess.landmarks_used[together.name], np.cumsum([len(p) for p in points])[:-1])
    return replace(guess, landmarks_used=dict(zip(names, used, strict=True)))


def _parameters(registration: Registration) -> Parameters:
    names = ("identity", "expression", "rotations", "scale", "translation")
    values = {name: torch.as_tensor(np.asarray(getattr(registration, name), np.float32)) for name in names}
    return Parameters(**values)
