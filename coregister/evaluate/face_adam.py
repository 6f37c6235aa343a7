"""The optimizer of [GNM, Generalization to Novel Shapes]: Adam, 5,000 steps, learning rate 1e-3 [Kingma 2015].

The squared distances are linearized again every few steps; within these no parameter moves by more than `refresh` x
`rate`, so that the gradient is that of the distances themselves. The unit of a parameter decides what a rate means:
coefficients are in standard deviations, rotations in radians, translations in metres, and the loss in mm^2, since Adam
adds 1e-8 to the size of gradients.
"""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from coregister.evaluate.face_fit import FaceFit, Stage
from registration.frames import MM_PER_M

_DECAY, _SQUARE_DECAY, _EPSILON = 0.9, 0.999, 1e-8


@dataclass(frozen=True, kw_only=True)
class AdamSettings:
    """Settings of the paper's optimizer.

    Attributes:
        steps: of each stage; 0: do not run it.
        rate: the learning rate.
        decay: the rate falls to this fraction of itself over the steps, exponentially; 1: constant, as in the paper.
        refresh: steps between two linearizations.
    """

    steps: int = 5000
    rate: float = 1e-3
    decay: float = 1.0
    refresh: int = 100


def adam(stage: Stage, start: FaceFit, settings: AdamSettings | None = None) -> FaceFit:
    """Return the fit after all steps; `converged` says whether the last tenth of them changed the cost by < 0.1 %.

    Args:
        stage: what to fit.
        start: where to start.
        settings: of the optimizer.
    """
    settings = settings or AdamSettings()
    fit, size = start, len(start.coefficients) + start.angles.size + 6
    mean, square = np.zeros(size), np.zeros(size)
    late = None
    for first in range(0, settings.steps, settings.refresh):
        if late is None and first >= 0.9 * settings.steps:
            late = stage.cost(fit)
        linear, moved = stage.linearize(fit), np.zeros(size)
        for number in range(first + 1, min(first + settings.refresh, settings.steps) + 1):
            gradient = _gradient(linear.matrix, linear.gradient, moved)
            mean = _DECAY * mean + (1 - _DECAY) * gradient
            square = _SQUARE_DECAY * square + (1 - _SQUARE_DECAY) * gradient**2
            rate = settings.rate * settings.decay ** (number / settings.steps)
            root = np.sqrt(square / (1 - _SQUARE_DECAY**number)) + _EPSILON
            moved = moved - rate * mean / (1 - _DECAY**number) / root
        fit = fit.moved(moved)
    last = stage.cost(fit)
    settled = late is not None and abs(late - last) <= 1e-3 * last
    return replace(fit, converged=settled, steps=settings.steps)


def _gradient(
    matrix: Float[np.ndarray, "N N"], gradient: Float[np.ndarray, "N"], moved: Float[np.ndarray, "N"]
) -> Float[np.ndarray, "N"]:
    """Of the mean squared distance in mm^2, after a motion from where it was linearized."""
    return 2 * MM_PER_M**2 * (gradient + matrix @ moved)
