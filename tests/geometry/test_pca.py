import numpy as np
import pytest

from registration.geometry.pca import uncentred_components


@pytest.mark.parametrize("count, size", [(30, 200), (300, 20)], ids=["products of samples", "products of entries"])
def test_components_are_those_of_a_dense_svd(count: int, size: int):
    rng = np.random.default_rng(0)
    samples = (rng.normal(size=(count, 12)) * 2.0 ** -np.arange(12)) @ rng.normal(size=(12, size)) + 0.3
    samples = samples.astype(np.float32)
    components, coefficients, energy = uncentred_components(list(samples), count, 0.999)
    u, s, vt = np.linalg.svd(samples.astype(np.float64), full_matrices=False)
    kept = int(np.searchsorted(np.cumsum(s**2) / (s**2).sum(), 0.999)) + 1
    assert len(components) == kept
    np.testing.assert_allclose(energy, s[:kept] ** 2 / (s**2).sum(), rtol=1e-4)
    np.testing.assert_allclose(np.abs(components), np.abs(s[:kept, None] * vt[:kept]) / np.sqrt(count), atol=2e-4)
    np.testing.assert_allclose((coefficients**2).mean(0), 1, rtol=1e-3)
    np.testing.assert_allclose(coefficients.T @ coefficients / count, np.eye(kept), atol=2e-3)
    assert (components[np.arange(kept), np.abs(components).argmax(1)] > 0).all()
    rebuilt = coefficients @ components
    assert ((samples - rebuilt) ** 2).sum() < 0.0011 * (samples**2).sum()


def test_nothing_moves():
    components, coefficients, energy = uncentred_components([np.zeros(5, np.float32)] * 3, 3, 0.99)
    assert components.shape == (0, 5) and coefficients.shape == (3, 0) and energy.shape == (0,)
