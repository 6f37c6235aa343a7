"""Levenberg-Marquardt for the energy of a landmark fit."""

from dataclasses import dataclass

import numpy as np

from registration.landmark_fit.energy import Problem
from registration.landmark_fit.linear_system import ArrowSystem, NotPositive
from registration.landmark_fit.state import Free, State, moved

_DAMPING = 1e-2
_GROWTH = 4.0  # of the damping after the first rejected step; it doubles with every further one
_LEAST, _MOST = 1e-12, 1e10
_PRECISION = 1e-11  # of the energy
_STALE = 0.5  # decrease relative to what second derivatives predict, below which they are computed again


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
    energy, damping, growth = problem.energy(state), _DAMPING, _GROWTH
    curvature: ArrowSystem | None = None
    for iteration in range(1, max_iterations + 1):
        coordinates = problem.coordinates(state, free)
        fresh = curvature is None or not problem.reuse
        if curvature is None or fresh:
            curvature = problem.system(state, free)
        else:
            curvature = problem.with_gradient(curvature, state, free)
        system = coordinates.applied(curvature)
        while True:
            try:
                local, shared = system.step(damping)
                candidate = moved(state, problem.layout, free, *coordinates.undone(local, shared))
                value = problem.energy(candidate, energy)
            except NotPositive:
                value = np.inf
            if value <= energy:
                break
            if not fresh:
                fresh, curvature = True, problem.system(state, free)
                system = coordinates.applied(curvature)
                continue
            damping, growth = damping * growth, growth * 2  # [Nielsen 1999]
            if damping > _MOST:
                return Minimum(state=state, energy=energy, iterations=iteration, converged=True)
        predicted = -system.predicted(local, shared)
        ratio = (energy - value) / predicted if predicted > 0 else 0.0
        damping, growth = max(damping * max(0.1, 1 - (2 * ratio - 1) ** 3), _LEAST), _GROWTH
        decrease = energy - value
        if ratio < _STALE and not fresh:
            curvature = None
        state, energy = candidate, value
        if decrease <= tolerance + _PRECISION * energy:
            return Minimum(state=state, energy=energy, iterations=iteration, converged=True)
    return Minimum(state=state, energy=energy, iterations=max_iterations, converged=False)
