import numpy as np
import pytest

from registration.geometry.pca import dense_components, principal_components, sketch_gb


@pytest.mark.parametrize("count, size", [(30, 200), (300, 20)], ids=["products of samples", "products of entries"])
def test_components_are_those_of_a_dense_svd(count: int, size: int):
    rng = np.random.default_rng(0)
    samples = (rng.normal(size=(count, 12)) * 2.0 ** -np.arange(12)) @ rng.normal(size=(12, size)) + 0.3
    samples = samples.astype(np.float32)
    principal = principal_components(list(samples), centred=False, variance_ratio=0.999)
    components, coefficients = principal.components, principal.coefficients(list(samples))
    energy = principal.variance / principal.total
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


def test_zero_samples_have_no_components():
    samples = [np.zeros(5, np.float32)] * 3
    principal = principal_components(samples, centred=False, variance_ratio=0.99)
    assert principal.components.shape == (0, 5) and principal.coefficients(samples).shape == (3, 0)
    assert principal.variance.shape == (0,) and principal.variance_ratio == 1


METHODS = ("samples", "covariance", "randomized")


def _faces(rng: np.random.Generator, count: int = 180, size: int = 240) -> np.ndarray:
    """Samples with a decreasing spectrum, as of faces, and a mean that is not zero."""
    scales = np.exp(-np.arange(60) / 6)
    axes = np.linalg.qr(rng.normal(size=(size, 60)))[0].T
    return ((rng.normal(size=(count, 60)) * scales) @ axes + 0.1 * axes[0]).astype(np.float32)


@pytest.mark.parametrize("centred", [False, True], ids=["about zero", "about the mean"])
@pytest.mark.parametrize("method", METHODS)
def test_every_method_equals_a_dense_svd(method: str, centred: bool):
    samples = _faces(np.random.default_rng(1))
    exact = samples.astype(np.float64)
    mean = exact.mean(0) if centred else np.zeros(exact.shape[1])
    _, s, vt = np.linalg.svd((exact - mean) / np.sqrt(len(exact) - centred), full_matrices=False)
    principal = principal_components(list(samples), centred=centred, max_components=20, method=method)
    assert principal.method == method and len(principal.variance) == 20
    np.testing.assert_allclose(principal.mean, mean, atol=1e-7)
    np.testing.assert_allclose(principal.variance, s[:20] ** 2, rtol=1e-4)
    assert principal.total == pytest.approx((s**2).sum(), rel=1e-5)
    aligned = vt[:20] * np.sign((vt[:20] * principal.components).sum(1))[:, None]
    assert np.abs(principal.components - s[:20, None] * aligned).max() < 1e-4 * s[0]
    assert (principal.components[np.arange(20), np.abs(principal.components).argmax(1)] > 0).all()


def test_the_variance_ratio_determines_the_number_of_components():
    samples = _faces(np.random.default_rng(2))
    full = principal_components(list(samples), centred=True)
    for ratio in (0.5, 0.9, 0.99):
        principal = principal_components(list(samples), centred=True, variance_ratio=ratio)
        fewer = full.variance[: len(principal.variance) - 1].sum() / full.total
        assert fewer < ratio <= principal.variance_ratio
    assert principal_components(
        list(samples), centred=True, variance_ratio=0.99, max_components=3
    ).components.shape == (3, 240)


def test_size_and_memory_determine_the_method():
    samples = list(_faces(np.random.default_rng(3)))
    methods = {
        gb: principal_components(samples, centred=True, max_components=5, memory_gb=gb).method for gb in (1, 1e-5)
    }
    assert methods == {1: "samples", 1e-5: "randomized"}
    many = [s[:30] for s in samples]
    assert principal_components(many, centred=True, max_components=5).method == "covariance"


def test_a_sketch_needs_no_number_of_components():
    """It grows until the variance is explained or the memory is full, and tells what it can have missed."""
    rng = np.random.default_rng(7)
    scales = np.exp(-np.arange(400) / 80)
    samples = list((rng.normal(size=(600, 400)) * scales).astype(np.float32) @ _axes(rng, 400, 500))
    exact = principal_components(samples, centred=False, variance_ratio=0.995, method="covariance")
    sketch = principal_components(samples, centred=False, variance_ratio=0.995, method="randomized")
    assert len(exact.variance) > 128 and abs(len(sketch.variance) - len(exact.variance)) <= 1
    assert sketch.variance_ratio >= 0.995 and exact.missed == 0
    full = principal_components(samples, centred=False, method="covariance")
    # 100 vectors fit: 50 components and as many more.
    small = principal_components(
        samples, centred=False, variance_ratio=0.995, method="randomized", memory_gb=sketch_gb(500, 50)
    )
    assert len(small.variance) == 50 and small.variance_ratio < 0.9
    best = full.variance[:50].sum() / full.total
    assert 0 <= best - small.variance_ratio < 1e-3 < small.missed
    assert best <= small.variance_ratio + small.missed


def _axes(rng: np.random.Generator, count: int, size: int) -> np.ndarray:
    return np.linalg.qr(rng.normal(size=(size, count)))[0].T.astype(np.float32)


def test_products_of_orthogonal_groups_are_not_needed():
    rng = np.random.default_rng(8)
    axes = _axes(rng, 60, 100)
    rows = [a @ axes[k * 30 : (k + 1) * 30] for k in (0, 1) for a in rng.normal(size=(20, 30)) * (1 + k)]
    order = rng.permutation(40)
    samples, groups = [rows[k].astype(np.float32) for k in order], (order >= 20).astype(int)
    whole = principal_components(samples, centred=False, variance_ratio=0.95)
    parts = principal_components(samples, centred=False, variance_ratio=0.95, groups=groups)
    np.testing.assert_allclose(parts.variance, whole.variance, rtol=1e-5)
    np.testing.assert_allclose(parts.components, whole.components, atol=1e-4)
    # Products between the groups would not have mattered: with wrong ones the result is another.
    mixed = principal_components(samples, centred=False, variance_ratio=0.95, groups=np.arange(40) % 2)
    assert np.abs(mixed.variance[:5] / whole.variance[:5] - 1).max() > 0.01
    for wrong in (groups[:-1], groups):
        with pytest.raises(ValueError, match="groups"):
            principal_components(samples, centred=len(wrong) == 40, groups=wrong)


def test_centred_samples_have_one_component_less():
    samples = list(_faces(np.random.default_rng(4), count=7))
    assert len(principal_components(samples, centred=True).variance) == 6
    assert len(principal_components([np.zeros(4, np.float32)] * 3, centred=True).variance) == 0


def test_there_must_be_samples():
    with pytest.raises(ValueError, match="0 samples"):
        principal_components([], centred=True)


@pytest.mark.parametrize("centred", [False, True], ids=["about zero", "about the mean"])
def test_dense_components_are_those_of_the_stream(centred: bool):
    samples = _faces(np.random.default_rng(6), count=60).astype(np.float64)
    components, deviation = dense_components(samples, 0.9, centred=centred)
    streamed = principal_components(list(samples), centred=centred, variance_ratio=0.9)
    assert len(components) == len(streamed.components)
    np.testing.assert_allclose(deviation, np.sqrt(streamed.variance), rtol=1e-4)
    np.testing.assert_allclose(components, streamed.components, atol=1e-4 * deviation[0])
