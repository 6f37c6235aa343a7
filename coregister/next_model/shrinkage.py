"""Covariance shrinkage: few registrations and the previous model's basis as one stream of samples.

The next model's covariance is (1 - p) C + p (tr C / tr P) P, with C of the registrations, P of the previous model and
the shrinkage p (docs/algorithms.md, "Covariance shrinkage"). [Ledoit 2004] shrinks towards a multiple of the identity;
here the target is the previous model, and p is given or chosen by cross-validation over subjects.
"""

from collections.abc import Iterable, Iterator, Sequence

import numpy as np
from jaxtyping import Bool, Float, Int

SHRINKAGE_GRID = tuple(round(0.05 * k, 2) for k in range(20))  # values that are compared: 0 to 0.95
FOLDS = 10  # at most; subjects of a fold are excluded together


class ShrunkCovariance:
    """A stream of rows whose mean square is (1 - p) C + p (tr C / tr P) P, as `geometry.pca` reads it, several times.

    C = sum_i w_i x_i x_i' / divisor over the samples, P = B'B of the previous model's components, which are scaled by
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
        """Read the samples once.

        Args:
            samples: N deviations, an iterable that gives the same rows each time it is read.
            weights: of the samples, at least 0.
            divisor: of the weighted sum of squares.
            previous: components of the previous model.
            shrinkage: p, from 0 to 1.
        """
        self._samples = samples
        energy = sum(w * float(x.astype(np.float64) @ x) for w, x in zip(weights, samples, strict=True)) / divisor
        previous_energy = float((previous**2).sum())
        self.shrinkage = shrinkage if previous_energy > 0 and energy > 0 else 0.0
        self._previous = previous if self.shrinkage > 0 else previous[:0]
        count = len(weights) + len(self._previous)
        self._sample_scales = np.sqrt((1 - self.shrinkage) * count * weights / divisor)
        energies = self.shrinkage * count * energy
        self._previous_scale = np.sqrt(energies / previous_energy) if self.shrinkage > 0 else 0.0

    def __iter__(self) -> Iterator[Float[np.ndarray, "D"]]:
        for scale, sample in zip(self._sample_scales, self._samples, strict=True):
            yield scale * sample
        for component in self._previous:
            yield self._previous_scale * component


def cross_validated_shrinkage(
    gram: Float[np.ndarray, "M M"],
    members: Sequence[Int[np.ndarray, "N"]],
    centred: Sequence[bool],
    components: int,
    grid: Sequence[float] = SHRINKAGE_GRID,
) -> Float[np.ndarray, "P"]:
    """Return the rms residual of excluded subjects for each shrinkage, by k-fold cross-validation over subjects.

    The residual is the distance of a subject's deviation from the span of the first components of a model of the other
    subjects and the previous model. Only products of rows are needed: every mean, component and residual is a linear
    combination of rows, so that the cost does not depend on the mesh.

    Args:
        gram: products of all rows with one another: samples, then the previous model's components.
        members: the N subjects' rows of each kind of part (deviations; or symmetric parts and antisymmetric ones). All
            other rows are the previous model's.
        centred: whether parts of that kind are about their mean, which every fold recomputes, with N - 1.
        components: number of components of the models.
        grid: values of the shrinkage.
    """
    count = len(members[0])
    previous = np.eye(len(gram))[np.setdiff1d(np.arange(len(gram)), np.concatenate(members))]
    squares = np.zeros(len(grid))
    for fold in range(min(FOLDS, count)):
        excluded = np.arange(count) % FOLDS == fold
        samples, test = _fold(len(gram), members, centred, excluded)
        squares += [_residual(gram, samples, previous, shrinkage, components, test) for shrinkage in grid]
    return np.sqrt(squares / count)


def _fold(
    size: int, members: Sequence[Int[np.ndarray, "N"]], centred: Sequence[bool], excluded: Bool[np.ndarray, "N"]
) -> tuple[Float[np.ndarray, "S M"], Float[np.ndarray, "T M"]]:
    """Training samples, scaled by the root of their divisor, and excluded deviations, as combinations of rows."""
    training, tests = [], []
    for rows, about_mean in zip(members, centred, strict=True):
        unit = np.eye(size)[rows]
        mean = unit[~excluded].mean(0) if about_mean else 0
        training.append((unit[~excluded] - mean) / np.sqrt(max((~excluded).sum() - about_mean, 1)))
        tests.append(unit[excluded] - mean)
    return np.concatenate(training), np.sum(tests, axis=0)


def _residual(
    gram: Float[np.ndarray, "M M"],
    samples: Float[np.ndarray, "S M"],
    previous: Float[np.ndarray, "K M"],
    shrinkage: float,
    components: int,
    test: Float[np.ndarray, "T M"],
) -> float:
    """Sum over tests of the squared distance from the span of the shrunk covariance's first components."""
    energy, previous_energy = (float(np.einsum("sm,mn,sn->", rows, gram, rows)) for rows in (samples, previous))
    scale = np.sqrt(shrinkage * energy / previous_energy)
    rows = np.concatenate([np.sqrt(1 - shrinkage) * samples, scale * previous])
    variance, vectors = np.linalg.eigh(rows @ gram @ rows.T)
    kept = np.flatnonzero(variance > 1e-11 * variance[-1])[-components:]
    basis = (vectors[:, kept] / np.sqrt(variance[kept])).T @ rows  # orthonormal in `gram`
    projection = test @ gram @ basis.T
    return float(np.einsum("tm,mn,tn->", test, gram, test) - (projection**2).sum())
