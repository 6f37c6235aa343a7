import numpy as np
import pytest

from registration.landmark_fit.linear_system import ArrowSystem, Coordinates, NotPositive


def _system(frames=5, n=4, m=3, temporal=True, seed=0):
    random = np.random.default_rng(seed)
    local = np.stack([a @ a.T for a in random.normal(size=(frames, n, 2 * n))])
    coupling = random.normal(size=(n, n))
    information = coupling @ coupling.T
    if temporal:
        local[1:] += information
        local[:-1] += information
    mixed = random.normal(size=(frames, n, m)) * 0.5
    return ArrowSystem(
        local=local,
        neighbours=-information if temporal else None,
        mixed=mixed,
        shared=10 * frames * np.eye(m),
        local_gradient=random.normal(size=(frames, n)),
        shared_gradient=random.normal(size=m),
        local_scale=random.uniform(1, 2, n),
        shared_scale=random.uniform(1, 2, m),
    )


@pytest.mark.parametrize("temporal", [False, True])
@pytest.mark.parametrize("damping", [0.0, 0.7])
def test_a_step_equals_that_of_the_dense_system(temporal, damping):
    system = _system(temporal=temporal)
    local, shared = system.step(damping)
    matrix, gradient = system.dense()
    scale = np.concatenate([np.tile(system.local_scale, len(system.local)), system.shared_scale])
    expected = -np.linalg.solve(matrix + damping * np.diag(scale), gradient)
    np.testing.assert_allclose(np.concatenate([local.ravel(), shared]), expected, atol=1e-8)
    assert system.predicted(local, shared) == pytest.approx(gradient @ expected + expected @ matrix @ expected / 2)


@pytest.mark.parametrize("temporal", [False, True])
def test_covariances_are_blocks_of_the_inverse(temporal):
    system = _system(temporal=temporal)
    inverse = np.linalg.inv(system.dense()[0])
    shared, blocks = system.covariances()
    n, frames = system.local.shape[1], len(system.local)
    np.testing.assert_allclose(shared, inverse[frames * n :, frames * n :], atol=1e-9)
    for f, (own, mixed) in zip(reversed(range(frames)), blocks, strict=True):
        rows = slice(f * n, f * n + n)
        np.testing.assert_allclose(own, inverse[rows, rows], atol=1e-9)
        np.testing.assert_allclose(mixed, inverse[rows, frames * n :], atol=1e-9)


@pytest.mark.parametrize("temporal", [False, True])
def test_other_coordinates_give_the_same_undamped_step(temporal):
    system = _system(temporal=temporal)
    random = np.random.default_rng(1)
    along, within = np.zeros((5, 4, 3)), np.zeros((3, 3))
    along[:, :, 1], within[2, 1] = random.normal(size=(5, 4)), 0.4
    coordinates = Coordinates(along=along, within=within)
    small = 1e-6  # the coordinates are those of a focal length's logarithm: linear for small steps alone
    scaled = ArrowSystem(
        **{
            **vars(system),
            "local_gradient": small * system.local_gradient,
            "shared_gradient": small * system.shared_gradient,
        }
    )
    local, shared = coordinates.undone(*coordinates.applied(scaled).step(0.0))
    expected_local, expected_shared = scaled.step(0.0)
    np.testing.assert_allclose(local, expected_local, atol=1e-11)
    np.testing.assert_allclose(shared, expected_shared, atol=1e-11)


def test_an_indefinite_system_is_refused():
    system = _system(temporal=False)
    with pytest.raises(NotPositive):
        ArrowSystem(**{**vars(system), "local": -system.local}).step(0.0)
