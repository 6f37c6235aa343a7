import numpy as np
import pytest

from registration.geometry.pca import dense_components, principal_components, uncentred_components


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


METHODS = ("samples", "covariance", "randomized")


def _faces(rng: np.random.Generator, count: int = 180, size: int = 240) -> np.ndarray:
    """Samples whose variances fall as those of faces do, away from zero."""
    scales = np.exp(-np.arange(60) / 6)
    axes = np.linalg.qr(rng.normal(size=(size, 60)))[0].T
    return ((rng.normal(size=(count, 60)) * scales) @ axes + 0.1 * axes[0]).astype(np.float32)


@pytest.mark.parametrize("weighted", [False, True], ids=["alike", "weighted"])
@pytest.mark.parametrize("centred", [False, True], ids=["about zero", "about the mean"])
@pytest.mark.parametrize("method", METHODS)
def test_every_way_gives_what_a_dense_svd_gives(method: str, centred: bool, weighted: bool):
    rng = np.random.default_rng(1)
    samples, weights = _faces(rng), rng.uniform(0.2, 2, 180) if weighted else np.ones(180)
    exact = samples.astype(np.float64)
    mean = weights @ exact / weights.sum() if centred else np.zeros(exact.shape[1])
    divisor = weights.sum() - (weights**2).sum() / weights.sum() if centred else weights.sum()
    _, s, vt = np.linalg.svd((exact - mean) * np.sqrt(weights / divisor)[:, None], full_matrices=False)
    given = weights if weighted else None
    found = principal_components(list(samples), centred=centred, most=20, weights=given, method=method)
    assert found.method == method and len(found.variance) == 20
    np.testing.assert_allclose(found.mean, mean, atol=1e-7)
    np.testing.assert_allclose(found.variance, s[:20] ** 2, rtol=1e-4)
    assert found.total == pytest.approx((s**2).sum(), rel=1e-5)
    aligned = vt[:20] * np.sign((vt[:20] * found.components).sum(1))[:, None]
    assert np.abs(found.components - s[:20, None] * aligned).max() < 1e-4 * s[0]
    assert (found.components[np.arange(20), np.abs(found.components).argmax(1)] > 0).all()


def test_a_share_decides_how_many_and_tells_what_it_kept():
    samples = _faces(np.random.default_rng(2))
    all_of = principal_components(list(samples), centred=True)
    for share in (0.5, 0.9, 0.99):
        found = principal_components(list(samples), centred=True, share=share)
        fewer = all_of.variance[: len(found.variance) - 1].sum() / all_of.total
        assert fewer < share <= found.share
    assert principal_components(list(samples), centred=True, share=0.99, most=3).components.shape == (3, 240)


def test_size_and_memory_choose_the_way():
    samples = list(_faces(np.random.default_rng(3)))
    ways = {gb: principal_components(samples, centred=True, most=5, memory_gb=gb).method for gb in (1, 1e-5)}
    assert ways == {1: "samples", 1e-5: "randomized"}
    many = [s[:30] for s in samples]
    assert principal_components(many, centred=True, most=5).method == "covariance"
    with pytest.raises(ValueError, match="most"):
        principal_components(samples, centred=True, memory_gb=1e-5)


def test_fewer_samples_than_numbers_have_one_component_less_when_centred():
    samples = list(_faces(np.random.default_rng(4), count=7))
    assert len(principal_components(samples, centred=True).variance) == 6
    assert len(principal_components([np.zeros(4, np.float32)] * 3, centred=True).variance) == 0


def test_weights_must_be_one_a_sample():
    samples = list(_faces(np.random.default_rng(5), count=7))
    for count in (6, 8):
        with pytest.raises(ValueError):
            principal_components(samples, centred=True, weights=np.ones(count))


@pytest.mark.parametrize("centred", [False, True], ids=["about zero", "about the mean"])
def test_dense_components_are_those_of_the_stream(centred: bool):
    samples = _faces(np.random.default_rng(6), count=60).astype(np.float64)
    components, deviation = dense_components(samples, 0.9, centred=centred)
    streamed = principal_components(list(samples), centred=centred, share=0.9)
    assert len(components) == len(streamed.components)
    np.testing.assert_allclose(deviation, np.sqrt(streamed.variance), rtol=1e-4)
    np.testing.assert_allclose(components, streamed.components, atol=1e-4 * deviation[0])
