"""Cross-validated shrinkage against explicit models of every fold."""

import numpy as np
import pytest

from coregister.next_model.shrinkage import (
    FOLDS,
    SHRINKAGE_GRID,
    SampleParts,
    ShrunkCovariance,
    cross_validated_shrinkage,
)
from registration.geometry.pca import principal_components

SIZE = 60


def _rms(kinds: list[tuple[np.ndarray, bool]], previous: np.ndarray, components: int, *grid: float) -> np.ndarray:
    parts = [SampleParts(coordinates=x, squares=(x**2).sum(1), centred=centred) for x, centred in kinds]
    square = float((previous**2).sum())
    return cross_validated_shrinkage(parts, previous, square, components, grid or SHRINKAGE_GRID)


def _best(samples: np.ndarray, previous: np.ndarray, components: int) -> float:
    return SHRINKAGE_GRID[int(_rms([(samples, True)], previous, components).argmin())]


@pytest.mark.parametrize("shrinkage", (0.0, 0.35, 0.95))
def test_coordinates_give_the_residuals_of_explicit_models(shrinkage):
    rng = np.random.default_rng(0)
    samples, previous = rng.normal(size=(13, SIZE)) + 5, rng.normal(size=(7, SIZE))
    rms = _rms([(samples, True)], previous, 6, shrinkage)
    squares = 0.0
    for fold in range(FOLDS):
        excluded = np.arange(13) % FOLDS == fold
        mean = samples[~excluded].mean(0)
        kept = samples[~excluded] - mean
        stream = ShrunkCovariance(kept, np.ones(len(kept)), len(kept) - 1, previous, shrinkage)
        basis = principal_components(stream, centred=False, max_components=6).components
        for test in samples[excluded] - mean:
            squares += ((test - np.linalg.lstsq(basis.T, test, rcond=None)[0] @ basis) ** 2).sum()
    assert rms[0] == pytest.approx(np.sqrt(squares / 13), rel=1e-5)


def test_both_parts_of_a_subject_are_excluded_together():
    rng = np.random.default_rng(1)
    even, odd, previous = np.zeros((11, SIZE)), np.zeros((11, SIZE)), np.zeros((4, SIZE))
    even[:, :30], odd[:, 30:] = rng.normal(size=(11, 30)) + 2, rng.normal(size=(11, 30))
    previous[:, :30] = rng.normal(size=(4, 30))
    both = _rms([(even, True), (odd, False)], previous, 100, 0.2)
    # With all components the residuals of both parts add up, since their spans are orthogonal.
    squares = 0.0
    for fold in range(FOLDS):
        excluded = np.arange(11) % FOLDS == fold
        mean = even[~excluded].mean(0)
        for test, span in (
            (even[excluded] - mean, np.concatenate([even[~excluded] - mean, previous])),
            (odd[excluded], odd[~excluded]),
        ):
            squares += ((test - test @ np.linalg.pinv(span) @ span) ** 2).sum()
    assert both[0] == pytest.approx(np.sqrt(squares / 11), rel=1e-6)


def test_few_samples_of_the_previous_model_give_much_shrinkage_and_many_others_little():
    rng = np.random.default_rng(2)
    model = rng.normal(size=(15, SIZE)) * 0.8 ** np.arange(15)[:, None]
    other = rng.normal(size=(6, SIZE))
    few = rng.normal(size=(8, 15)) @ model
    assert _best(few, model, 10) >= 0.5
    many = rng.normal(size=(200, 6)) @ other
    assert _best(many, model, 6) <= 0.1


def test_what_the_coordinates_leave_out_counts_in_every_model():
    """As much for each shrinkage: the number of coordinates changes no choice."""
    rng = np.random.default_rng(3)
    samples, previous = rng.normal(size=(30, SIZE)) * 0.8 ** np.arange(SIZE), np.zeros((5, SIZE))
    previous[:, :20] = rng.normal(size=(5, 20))
    whole = _rms([(samples, True)], previous, 5)
    part = SampleParts(coordinates=samples[:, :40], squares=(samples**2).sum(1), centred=True)
    fewer = cross_validated_shrinkage([part], previous[:, :40], float((previous**2).sum()), 5)
    np.testing.assert_allclose(fewer, whole, rtol=1e-4)
