"""Covariance shrinkage: few registrations and a prior model's basis as one stream of samples.

The next model's covariance is (1 - p) C + p (tr C / tr P) P, with C of the registrations, P of the prior model and
the shrinkage p (docs/algorithms.md, "Covariance shrinkage"). [Ledoit 2004] shrinks towards a multiple of the identity;
here the target is a model that was built from none of the subjects, and p is given or chosen by cross-validation over
subjects.
"""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float
from scipy.linalg import eigh

SHRINKAGE_GRID = tuple(round(0.05 * k, 2) for k in range(20))  # values that are compared: 0 to 0.95
FOLDS = 10  # at most; subjects of a fold are excluded together


class ShrunkCovariance:
    """A stream of rows whose mean square is (1 - p) C + p (tr C / tr P) P, as `geometry.pca` reads it, several times.

    C = sum_i w_i x_i x_i' / divisor over the samples, P = B'B of the prior model's components, which are scaled by
    standard deviations: the covariance of an infinite sample of that model. The total variance is the samples'. Without
    previous components, or without variance of the samples, p is 0.

    Attributes:
        shrinkage: p as it is used.
    """

    def __init__(
        self,
        samples: Iterable[Float[np.ndarray, "D"]],
        weights: Float[np.ndarray, "N"],
        divisor: float,
        previous: Float[np.ndarray, "K D"],
        shrinkage: float,
    ):
        """Read the samples once, unless p is 0.

        Args:
            samples: N deviations, an iterable that gives the same rows each time it is read.
            weights: of the samples, at least 0.
            divisor: of the weighted sum of squares.
            previous: components of the previous model.
            shrinkage: p, from 0 to 1.
        """
        self._samples = samples
        energy, previous_energy = 0.0, float((previous**2).sum()) if shrinkage > 0 else 0.0
        if previous_energy > 0:
            energy = sum(w * float(x.astype(np.float64) @ x) for w, x in zip(weights, samples, strict=True)) / divisor
        self.shrinkage = shrinkage if previous_energy > 0 and energy > 0 else 0.0
        self._previous = previous if self.shrinkage > 0 else previous[:0]
        count = len(weights) + len(self._previous)
        self._sample_scales = np.sqrt((1 - self.shrinkage) * count * weights / divisor)
        energies = self.shrinkage * count * energy
        self._previous_scale = np.sqrt(energies / previous_energy) if self.shrinkage > 0 else 0.0

    def __len__(self) -> int:
        """Return the number of rows."""
        return len(self._sample_scales) + len(self._previous)

    def __iter__(self) -> Iterator[Float[np.ndarray, "D"]]:
        for scale, sample in zip(self._sample_scales, self._samples, strict=True):
            yield scale * sample
        for component in self._previous:
            yield self._previous_scale * component


@dataclass(frozen=True, kw_only=True, eq=False)
class SampleParts:
    """Parts of one kind of all subjects' deviations, such as the symmetric ones, in r orthonormal coordinates."""

    coordinates: Float[np.ndarray, "N r"]
    squares: Float[np.ndarray, "N"]  # lengths squared, with what the coordinates leave out
    centred: bool  # about their mean, which every fold recomputes, with N - 1; else about zero


def cross_validated_shrinkage(
    kinds: Sequence[SampleParts],
    prior: Float[np.ndarray, "K r"],
    prior_square: float,
    components: int,
    grid: Sequence[float] = SHRINKAGE_GRID,
) -> Float[np.ndarray, "P"]:
    """Return the rms residual of excluded subjects for each shrinkage, by k-fold cross-validation over subjects.

    The residual is the distance of a subject's deviation from the span of the first components of a model of the other
    subjects and the prior. The coordinates span what first components can be made of, so that the cost of each model
    depends neither on the mesh nor on the number of subjects.

    Args:
        kinds: of parts, orthogonal to one another; a subject's deviation is the sum of its parts.
        prior: components of a model that was built from none of the subjects.
        prior_square: sum of the components' squares, with what the coordinates leave out.
        components: number of components of the models.
        grid: values of the shrinkage.
    """
    count = len(kinds[0].squares)
    prior_covariance = prior.T @ prior / prior_square
    squares = np.zeros(len(grid))
    for fold in range(min(FOLDS, count)):
        excluded = np.arange(count) % FOLDS == fold
        covariance, energy, tests, test_square = _fold(kinds, excluded)
        for k, shrinkage in enumerate(grid):
            mixed = (1 - shrinkage) * covariance + shrinkage * energy * prior_covariance
            squares[k] += test_square - _explained(mixed, components, tests)
    return np.sqrt(np.maximum(squares, 0) / count)


def _fold(
    kinds: Sequence[SampleParts], excluded: Bool[np.ndarray, "N"]
) -> tuple[Float[np.ndarray, "r r"], float, Float[np.ndarray, "T r"], float]:
    """Covariance of the other subjects and its trace; the excluded deviations and the sum of their squares."""
    size = kinds[0].coordinates.shape[1]
    covariance, energy, square = np.zeros((size, size)), 0.0, 0.0
    tests = np.zeros((int(excluded.sum()), size))
    for kind in kinds:
        training, test = kind.coordinates[~excluded], kind.coordinates[excluded]
        mean = training.mean(0) if kind.centred else np.zeros(size)
        divisor = max(len(training) - kind.centred, 1)
        covariance += (training - mean).T @ (training - mean) / divisor
        energy += float(kind.squares[~excluded].sum() - len(training) * mean @ mean) / divisor
        tests += test - mean
        square += float(kind.squares[excluded].sum() - 2 * (test @ mean).sum() + len(test) * mean @ mean)
    return covariance, energy, tests, square


def _explained(covariance: Float[np.ndarray, "r r"], components: int, tests: Float[np.ndarray, "T r"]) -> float:
    """Sum of the squared projections of the tests onto the first components."""
    size = len(covariance)
    first = max(size - components, 0)
    variance, vectors = eigh(covariance, subset_by_index=(first, size - 1), check_finite=False)
    return float(((tests @ vectors[:, variance > 1e-11 * variance[-1]]) ** 2).sum())
