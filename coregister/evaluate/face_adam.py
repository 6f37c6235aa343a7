"""The optimizer of [GNM, Generalization to Novel Shapes]: Adam, 5,000 steps, learning rate 1e-3 [Kingma 2015].

The squared distances are linearized again every few steps; within these no parameter moves by more than `refresh` x
`rate`, so that the gradient is that of the distances themselves.

The unit of a parameter decides what a rate means, and the paper does not state it. In standard deviations, radians and
metres Adam stops short: components that hardly differ on the face need tens of standard deviations, which 5,000 steps
of 1e-3 cannot reach. The default coordinates are whitened instead: along the principal axes of the Gauss-Newton matrix
at the start, in units that change the face by the distance at the start (root mean square). They leave the minimum
where it is. The loss is in mm^2, since Adam adds 1e-8 to the size of gradients.
"""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from coregister.evaluate.face_fit import FaceFit, Linearized, Stage
from registration.frames import MM_PER_M

_DECAY, _SQUARE_DECAY, _EPSILON = 0.9, 0.999, 1e-8
_SINGULAR = 1e-5  # of the largest eigenvalue: along directions that matter less, steps are too long to be linear
_UNMOVED_M2 = 1e-24  # mean square of a motion that is none


@dataclass(frozen=True, kw_only=True)
class AdamSettings:
    """Settings of the paper's optimizer.

    Attributes:
        steps: of each stage; 0: do not run it.
        rate: the learning rate.
        decay: the rate falls to this fraction of itself over the steps, exponentially; 1: constant, as in the paper.
        refresh: steps between two linearizations.
        whitened: step in coordinates in which the distances are equally curved in all directions; False: in
            standard deviations, radians and metres.
    """

    steps: int = 5000
    rate: float = 1e-3
    decay: float = 1.0
    refresh: int = 100
    whitened: bool = True


def adam(stage: Stage, start: FaceFit, settings: AdamSettings | None = None) -> FaceFit:
    """Return the fit after all steps; `converged` says whether the last tenth of them changed the cost by < 0.1 %.

    Args:
        stage: what to fit.
        start: where to start.
        settings: of the optimizer.
    """
    settings = settings or AdamSettings()
    fit, linear = start, stage.linearize(start)
    axes = _whitening(linear) if settings.whitened else np.eye(len(linear.gradient))
    mean, square = np.zeros(axes.shape[1]), np.zeros(axes.shape[1])
    late = None
    for first in range(0, settings.steps, settings.refresh):
        if late is None and first >= 0.9 * settings.steps:
            late = stage.cost(fit)
        if first:
            linear = stage.linearize(fit)
        matrix, slope, moved = axes.T @ linear.matrix @ axes, axes.T @ linear.gradient, np.zeros(axes.shape[1])
        for number in range(first + 1, min(first + settings.refresh, settings.steps) + 1):
            gradient = _gradient(matrix, slope, moved)
            mean = _DECAY * mean + (1 - _DECAY) * gradient
            square = _SQUARE_DECAY * square + (1 - _SQUARE_DECAY) * gradient**2
            rate = settings.rate * settings.decay ** (number / settings.steps)
            root = np.sqrt(square / (1 - _SQUARE_DECAY**number)) + _EPSILON
            moved = moved - rate * mean / (1 - _DECAY**number) / root
        fit = fit.moved(axes @ moved)
    last = stage.cost(fit)
    settled = late is not None and abs(late - last) <= 1e-3 * last
    return replace(fit, converged=settled, steps=settings.steps)


def _whitening(linear: Linearized) -> Float[np.ndarray, "N M"]:
    """Return the parameters of each whitened coordinate; directions that change nothing are left out.

    A unit changes the face by the distance at the start (root mean square): no minimum is further away.
    The matrix is scaled to the diagonal one first, so that parameters of all units are judged alike.
    """
    squares = np.diag(linear.matrix)
    moving = squares > _UNMOVED_M2
    scale = np.sqrt(squares[moving])
    values, vectors = np.linalg.eigh(linear.matrix[np.ix_(moving, moving)] / np.outer(scale, scale))
    kept = values > _SINGULAR * values[-1]
    axes = np.zeros((len(squares), int(kept.sum())))
    axes[moving] = np.sqrt(linear.cost) * vectors[:, kept] / np.sqrt(values[kept]) / scale[:, None]
    return axes


def _gradient(
    matrix: Float[np.ndarray, "N N"], gradient: Float[np.ndarray, "N"], moved: Float[np.ndarray, "N"]
) -> Float[np.ndarray, "N"]:
    """Of the mean squared distance in mm^2, after a motion from where it was linearized."""
    return 2 * MM_PER_M**2 * (gradient + matrix @ moved)
