"""Levenberg-Marquardt for the energy of a landmark fit."""

from dataclasses import dataclass

import numpy as np

from registration.landmark_fit.energy import Problem
from registration.landmark_fit.linear_system import NotPositive
from registration.landmark_fit.state import Free, State, moved

_DAMPING = 1e-2
_LEAST, _MOST = 1e-12, 1e10
_PRECISION = 1e-11  # of the energy


@dataclass(frozen=True, kw_only=True, eq=False)
class Minimum:
    """Where a minimization ended."""

    state: State
    energy: float
    iterations: int
    converged: bool


def minimize(problem: Problem, state: State, free: Free, max_iterations: int, tolerance: float) -> Minimum:
    """Minimize the energy over the free columns by damped Gauss-Newton steps.

    Args:
        problem: the energy.
        state: where to begin.
        free: columns of the unknowns.
        max_iterations: linearizations at most.
        tolerance: decrease of the energy below which a step is the last; in units of the logarithm of the posterior.
    """
    energy, damping, growth = problem.energy(state), _DAMPING, 2.0
    for iteration in range(1, max_iterations + 1):
        coordinates = problem.coordinates(state, free)
        system = coordinates.applied(problem.system(state, free))
        while True:
            try:
                local, shared = system.step(damping)
                candidate = moved(state, problem.layout, free, *coordinates.undone(local, shared))
                value = problem.energy(candidate)
            except NotPositive:
                value = np.inf
            if value <= energy:
                break
            damping, growth = damping * growth, growth * 2  # [Nielsen 1999]
            if damping > _MOST:
                return Minimum(state=state, energy=energy, iterations=iteration, converged=True)
        predicted = -system.predicted(local, shared)
        ratio = (energy - value) / predicted if predicted > 0 else 0.0
        damping, growth = max(damping * max(1 / 3, 1 - (2 * ratio - 1) ** 3), _LEAST), 2.0
        decrease = energy - value
        state, energy = candidate, value
        if decrease <= tolerance + _PRECISION * energy:
            return Minimum(state=state, energy=energy, iterations=iteration, converged=True)
    return Minimum(state=state, energy=energy, iterations=max_iterations, converged=False)
