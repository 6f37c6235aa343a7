"""Principal components: of samples that are read as a stream, or of a small matrix in memory.

Components are scaled by their standard deviation, so that coefficients have unit variance, and their largest entry is
positive, which makes them unique. See docs/algorithms.md, "Principal components".
"""

import itertools
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.linalg import eigh, qr

Method = Literal["samples", "covariance", "randomized"]
_BLOCK = 256  # samples in memory at once
_POWER_ITERATIONS = 2
_FIRST_SKETCH = 128  # components of the first sketch where their number is not given; doubled until they suffice
_SKETCH_BYTES = 12  # of each number of a sketched vector: the image, its factors and a block's share, float32
_MIN_VARIANCE = 1e-11  # of the largest: below it is rounding


@dataclass(frozen=True, kw_only=True)
class PrincipalComponents:
    """K principal components of a stream of samples, in descending order of variance."""

    mean: Float[np.ndarray, "D"]  # of the samples; zero if they were not centred
    components: Float[np.ndarray, "K D"]  # orthogonal, each scaled by its standard deviation
    variance: Float[np.ndarray, "K"]
    total: float  # variance of all the samples
    method: Method
    missed: float = 0.0  # of a sketch: as many other components explain at most this fraction of the variance more

    @property
    def variance_ratio(self) -> float:
        """Fraction of the total variance that the components explain."""
        return float(self.variance.sum() / self.total) if self.total > 0 else 1.0

    def coefficients(self, samples: Iterable[Float[np.ndarray, "D"]]) -> Float[np.ndarray, "N K"]:
        """Return the coefficients of samples, which are read once: projections in units of standard deviations."""
        axes = self.components.T / self.variance
        return np.concatenate([(block - self.mean) @ axes for block in _blocks(samples)])


def dense_components(
    samples: Float[np.ndarray, "N D"], variance_ratio: float, *, centred: bool
) -> tuple[Float[np.ndarray, "K D"], Float[np.ndarray, "K"]]:
    """Return the fewest components that explain this fraction of the variance of samples in memory.

    In float64 throughout, while `principal_components` reads float32 blocks.

    Args:
        samples: fewer than D, since the N x N matrix of their products is decomposed.
        variance_ratio: fraction of the variance, 0 to 1.
        centred: about the mean, divided by N - 1; else about zero, divided by N.

    Returns:
        Components and their standard deviations.
    """
    deviations = samples - samples.mean(0) if centred else samples
    count = len(samples) - 1 if centred else len(samples)
    variance, vectors = _descending(*np.linalg.eigh(deviations @ deviations.T / count))
    kept = int(np.searchsorted(np.cumsum(variance) / variance.sum(), variance_ratio)) + 1
    components = vectors[:, :kept].T @ deviations / np.sqrt(count)
    return components * _signs(components)[:, None], np.sqrt(variance[:kept])


def principal_components(
    samples: Iterable[Float[np.ndarray, "D"]],
    *,
    centred: bool,
    variance_ratio: float = 1.0,
    max_components: int | None = None,
    groups: Int[np.ndarray, "N"] | None = None,
    memory_gb: float = 4.0,
    method: Method | None = None,
    seed: int = 0,
) -> PrincipalComponents:
    """Return the fewest components that explain a fraction of the variance, without holding all samples at once.

    Centred: about the mean, with the divisor N - 1; else about zero, with N. Three methods, the first for which
    `memory_gb` suffices unless `method` names one:

    - samples: the N x N products of samples, which are held, if there are no more than D; exact
    - covariance: the D x D products of entries, float32 blocks summed in float64; exact to 3e-6
    - randomized: subspace iteration [Halko 2011] with as many additional vectors as components and two power
      iterations. Each pass reads the samples once. Without `max_components` sketches of 128, 256, ... components are
      made until they explain the fraction, or fill the memory: then fewer components are returned. `missed` tells what
      a sketch can have missed.

    Args:
        samples: an iterable that can be read several times and gives the same samples each time.
        centred: subtract the mean.
        variance_ratio: fraction of the variance that the components must explain, at least.
        max_components: at most as many; None: any number.
        groups: of the samples; those of different groups are orthogonal, and their products are not computed. Not with
            `centred`, as a mean belongs to all groups.
        memory_gb: available for matrices.
        method: of the computation.
        seed: of the randomized method.

    Raises:
        ValueError: no samples, other than one group each, or groups of centred samples.
    """
    stream = _first_pass(samples, centred)
    size = len(stream.mean)
    groups = np.zeros(stream.count, np.int64) if groups is None else groups
    if len(groups) != stream.count or (centred and groups.any()):
        raise ValueError(f"{stream.count} samples and {len(groups)} groups, centred: {centred}")
    if method is None:
        method = _affordable(np.bincount(groups), size, memory_gb * 1e9)

    def kept(variance: Float[np.ndarray, "_"]) -> int:
        return _kept(variance, stream.total, variance_ratio, max_components)

    missed = 0.0
    if method == "samples":
        variance, components = _by_samples(stream, groups, kept)
    elif method == "covariance":
        variance, components = _by_covariance(stream, max_components)
    else:
        variance, components, missed = _by_sketch(stream, variance_ratio, max_components, memory_gb * 1e9, seed)
    count = kept(variance)
    # As C = V diag(variance) V', the rows of sqrt(variance) V' are the components.
    components = components[:count]
    components *= (np.sqrt(variance[:count]) * _signs(components))[:, None]
    return PrincipalComponents(
        mean=stream.mean,
        components=components,
        variance=variance[:count],
        total=stream.total,
        method=method,
        missed=missed,
    )


def is_exact(count: int, size: int, memory_gb: float) -> bool:
    """Return whether `principal_components` of so many samples of `size` numbers, in one group, is no sketch."""
    return _affordable(np.array([count]), size, memory_gb * 1e9) != "randomized"


def sketch_gb(size: int, components: int) -> float:
    """Return the memory that the randomized method needs for so many components of samples of `size` numbers."""
    return 2 * components * size * _SKETCH_BYTES / 1e9


def _blocks(samples: Iterable[Float[np.ndarray, "D"]]) -> Iterator[Float[np.ndarray, "B D"]]:
    """Stacks of float32 samples."""
    rest = iter(samples)
    while block := [np.asarray(sample, np.float32) for sample in itertools.islice(rest, _BLOCK)]:
        yield np.stack(block)


@dataclass(frozen=True, kw_only=True)
class _ScaledStream:
    """A stream whose blocks are rows (x - mean) / sqrt(divisor), so that their products sum to the covariance."""

    samples: Iterable[Float[np.ndarray, "D"]]
    scale: float
    mean: Float[np.ndarray, "D"]
    total: float
    count: int

    def __iter__(self) -> Iterator[Float[np.ndarray, "B D"]]:
        return self.only(np.ones(self.count, bool))

    def only(self, chosen: Bool[np.ndarray, "N"]) -> Iterator[Float[np.ndarray, "B D"]]:
        """Yield blocks of the chosen samples alone."""
        mean = self.mean.astype(np.float32)
        for block in _blocks(itertools.compress(self.samples, chosen)):
            yield (block - mean) * np.float32(self.scale)


def _first_pass(samples: Iterable[Float[np.ndarray, "D"]], centred: bool) -> _ScaledStream:
    count, total, squares = 0, np.zeros(0), 0.0
    for block in _blocks(samples):
        total = block.sum(0, dtype=np.float64) + (total if count else 0)
        squares += float(np.square(block, dtype=np.float64).sum())
        count += len(block)
    if not count:
        raise ValueError("0 samples")
    mean = total / count if centred else np.zeros_like(total)
    divisor = max(count - 1, 1) if centred else count
    variance = (squares - count * float(mean @ mean)) / divisor
    return _ScaledStream(samples=samples, scale=divisor**-0.5, mean=mean, total=max(variance, 0.0), count=count)


def _affordable(counts: Int[np.ndarray, "G"], size: int, memory: float) -> Method:
    # An eigensolver needs twice the matrix in addition; vectors of all groups are kept.
    largest = int(counts.max())
    needed = 4 * largest * size + 16 * largest**2 + 8 * int((counts**2).sum())
    if counts.sum() <= size and needed <= memory:
        return "samples"
    return "covariance" if 28 * size**2 <= memory else "randomized"


def _by_samples(
    stream: _ScaledStream, groups: Int[np.ndarray, "N"], kept: Callable[[Float[np.ndarray, "_"]], int]
) -> tuple[Float[np.ndarray, "K"], Float[np.ndarray, "K D"]]:
    found = []
    for group in np.unique(groups):
        variance, vectors = _of_products(np.concatenate(list(stream.only(groups == group))))
        found.append((group, variance, vectors))
    every = np.concatenate([variance for _, variance, _ in found])
    order = np.argsort(-every, kind="stable")
    order = order[: kept(every[order])]
    rank = np.full(len(every), -1)
    rank[order] = np.arange(len(order))
    components, first = np.zeros((len(order), len(stream.mean))), 0
    for group, variance, vectors in found:
        ranks = rank[first : first + len(variance)]
        first += len(variance)
        chosen, rows = ranks >= 0, 0
        axes = np.zeros((int(chosen.sum()), components.shape[1]))
        coefficients = vectors[:, chosen] / np.sqrt(variance[chosen])
        for block in stream.only(groups == group):
            axes += coefficients[rows : rows + len(block)].T @ block
            rows += len(block)
        components[ranks[chosen]] = axes
    return every[order], components


def _of_products(rows: Float[np.ndarray, "N D"]) -> tuple[Float[np.ndarray, "K"], Float[np.ndarray, "N K"]]:
    """Eigenvalues, without those that are rounding, and eigenvectors of the rows' products."""
    products = np.zeros((len(rows), len(rows)))
    for first in range(0, rows.shape[1], 4096):  # float64 sums over float32 blocks
        block = rows[:, first : first + 4096].astype(np.float64)
        products += block @ block.T
    variance, vectors = _descending(*eigh(products, overwrite_a=True, check_finite=False))
    solid = int((variance > _MIN_VARIANCE * variance[0]).sum())
    return variance[:solid], vectors[:, :solid]


def _by_covariance(
    stream: _ScaledStream, max_components: int | None
) -> tuple[Float[np.ndarray, "K"], Float[np.ndarray, "K D"]]:
    size = len(stream.mean)
    products = np.zeros((size, size))
    for block in stream:
        products += block.T @ block
    subset = None if max_components is None or max_components >= size else (size - max_components, size - 1)
    variance, vectors = _descending(*eigh(products, subset_by_index=subset, overwrite_a=True, check_finite=False))
    solid = variance > _MIN_VARIANCE * variance[0]
    return variance[solid], vectors[:, solid].T


def _by_sketch(
    stream: _ScaledStream, variance_ratio: float, max_components: int | None, memory: float, seed: int
) -> tuple[Float[np.ndarray, "K"], Float[np.ndarray, "K D"], float]:
    """Variance, axes, and the fraction of the variance outside the sketched space.

    For a symmetric positive matrix the sum of the K largest eigenvalues is at most that of its part in a space plus the
    trace of the rest [Fan 1951], so that no K axes explain more than ours by more than that fraction.
    """
    size = len(stream.mean)
    largest = min(stream.count, size)
    if max_components is None:
        largest = max(1, min(largest, int(memory / (2 * _SKETCH_BYTES * size))))
    else:
        largest = min(largest, max_components)
    components = largest if max_components is not None else min(_FIRST_SKETCH, largest)
    while True:
        variance, axes, held = _sketched(stream, components, seed)
        if components == largest or variance[:components].sum() >= variance_ratio * stream.total:
            missed = 1 - held / stream.total if stream.total > 0 else 0.0
            return variance, axes, max(missed, 0.0)
        components = min(2 * components, largest)


def _sketched(
    stream: _ScaledStream, components: int, seed: int
) -> tuple[Float[np.ndarray, "K"], Float[np.ndarray, "K D"], float]:
    """Variance and axes of the components in a sketched space, and the variance in all of it."""
    size = len(stream.mean)
    width = min(2 * components, size)
    basis = np.random.default_rng(seed).standard_normal((size, width), dtype=np.float32)
    for _ in range(1 + _POWER_ITERATIONS):
        image = np.zeros((size, width), np.float32)
        for block in stream:
            image += block.T @ (block @ basis)
        basis = qr(image, mode="economic", overwrite_a=True, check_finite=False)[0]
    products = np.zeros((width, width))
    for block in stream:
        projections = (block @ basis).astype(np.float64)
        products += projections.T @ projections
    variance, vectors = _descending(*np.linalg.eigh(products))
    axes = vectors[:, :components].T.astype(np.float32) @ basis.T
    return variance[:components], axes.astype(np.float64), float(variance.sum())


def _descending(
    variance: Float[np.ndarray, "K"], vectors: Float[np.ndarray, "D K"]
) -> tuple[Float[np.ndarray, "K"], Float[np.ndarray, "D K"]]:
    return np.maximum(variance[::-1], 0), vectors[:, ::-1]


def _signs(components: Float[np.ndarray, "K D"]) -> Float[np.ndarray, "K"]:
    """The sign of each component's largest entry."""
    if not len(components):
        return np.zeros(0)
    return np.sign(components[np.arange(len(components)), np.abs(components).argmax(1)])


def _kept(variance: Float[np.ndarray, "K"], total: float, variance_ratio: float, max_components: int | None) -> int:
    """Number of components that explain the variance ratio, without those that are rounding."""
    solid = int((variance > _MIN_VARIANCE * variance.max(initial=0)).sum())
    enough = int(np.searchsorted(np.cumsum(variance), variance_ratio * total)) + 1 if total > 0 else 0
    return min(enough, solid, len(variance) if max_components is None else max_components)
