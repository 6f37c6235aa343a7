"""The gradient and the normal equations of the energy, against finite differences."""

from dataclasses import replace

import numpy as np
import pytest

from registration.landmark_fit import stages
from registration.landmark_fit.fit import fit_landmarks
from registration.landmark_fit.options import FitOptions, TemporalPrior
from registration.landmark_fit.state import Free, moved
from tests.registration.landmark_fit.scenes import Scene, rotated, scheme, tiny

OPTIONS = FitOptions(
    temporal=TemporalPrior(), principal_point=True, distortion=True, size=True, covariance=False, max_iterations=1
)


@pytest.fixture(scope="module", params=[False, True], ids=["squares", "robust"])
def case(request, monkeypatch_module):
    data = tiny()
    scene = Scene(data, scheme(data, 60, spread_m=1e-3), views=2, frames=3)
    caught = []
    original = stages.minimize

    def catching(problem, state, free, *limits):
        caught.append((problem, state, free))
        return original(problem, state, free, *limits)

    monkeypatch_module.setattr(stages, "minimize", catching)
    fit_landmarks(scene.observations(noise=2, known=False, poses=False), data, OPTIONS)
    problem, state, free = caught[-1]
    random = np.random.default_rng(0)
    state = replace(
        state,
        identity=state.identity + random.normal(size=state.identity.shape) * 0.3,
        k1=state.k1 + 0.05,
        principal_px=state.principal_px + 3,
        joints=rotated(state.joints, 1, 0.05),
        position=state.position + random.normal(size=state.position.shape) * 2e-3,
    )
    return replace(problem, robust=request.param), state, free


@pytest.fixture(scope="module")
def monkeypatch_module():
    with pytest.MonkeyPatch.context() as patch:
        yield patch


def _numeric(problem, state, free):
    frames, n, m = len(state.position), len(free.local), len(free.shared)
    step = 1e-6

    def change(local, shared):
        values = [
            problem.energy(moved(state, problem.layout, free, sign * local, sign * shared)) for sign in (step, -step)
        ]
        return (values[0] - values[1]) / (2 * step)

    local = np.zeros((frames, n))
    for f in range(frames):
        for k in range(n):
            unit = np.zeros((frames, n))
            unit[f, k] = 1
            local[f, k] = change(unit, np.zeros(m))
    return local, np.array([change(np.zeros((frames, n)), unit) for unit in np.eye(m)])


def _assert_close(actual, expected):
    scale = np.abs(expected).max()
    # Priors of rotations are linearized: exact at small angles alone.
    np.testing.assert_allclose(actual, expected, atol=2e-3 * scale, rtol=2e-2)


def test_the_gradient_is_that_of_finite_differences(case):
    problem, state, free = case
    system = problem.system(state, free)
    local, shared = _numeric(problem, state, free)
    _assert_close(system.local_gradient, local)
    _assert_close(system.shared_gradient, shared)


def test_the_gradient_without_derivatives_is_the_same(case):
    problem, state, free = case
    system = problem.system(state, free)
    other = problem.with_gradient(system, state, free)
    np.testing.assert_allclose(other.local_gradient, system.local_gradient, rtol=1e-8, atol=1e-6)
    np.testing.assert_allclose(other.shared_gradient, system.shared_gradient, rtol=1e-8, atol=1e-6)


def test_every_unknown_is_free(case):
    problem, _, free = case
    layout = problem.layout
    known = np.arange(layout.shared_count)[layout.shared("poses")]
    assert isinstance(free, Free)
    assert len(free.local) == layout.local_count
    assert set(np.arange(layout.shared_count)) - set(free.shared) < set(known)
