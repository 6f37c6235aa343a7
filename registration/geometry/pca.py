"""Principal components: of samples that are read as a stream, or of a small matrix in memory.

Components are scaled by their standard deviation, so that coefficients have unit variance, and their largest entry is
positive, which makes them unique. See docs/algorithms.md, "Principal components".
"""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float
from scipy.linalg import eigh

Method = Literal["samples", "covariance", "randomized"]
_BLOCK = 64  # samples in memory at once
_POWER_ITERATIONS = 2
_MIN_VARIANCE = 1e-11  # of the largest: below it is rounding


@dataclass(frozen=True, kw_only=True)
class PrincipalComponents:
    """K principal components of a stream of samples, in descending order of variance."""

    mean: Float[np.ndarray, "D"]  # of the samples; zero if they were not centred
    components: Float[np.ndarray, "K D"]  # orthogonal, each scaled by its standard deviation
    variance: Float[np.ndarray, "K"]
    total: float  # variance of all the samples
    method: Method

    @property
    def variance_ratio(self) -> float:
        """Fraction of the total variance that the components explain."""
        return float(self.variance.sum() / self.total) if self.total > 0 else 1.0

    def coefficients(self, samples: Iterable[Float[np.ndarray, "D"]]) -> Float[np.ndarray, "N K"]:
        """Return the coefficients of samples, which are read once: projections in units of standard deviations."""
        axes = self.components.T / self.variance
        return np.concatenate([(block - self.mean) @ axes for _, block in _blocks(samples)])


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
    weights: Float[np.ndarray, "N"] | None = None,
    memory_gb: float = 4.0,
    method: Method | None = None,
    seed: int = 0,
) -> PrincipalComponents:
    """Return the fewest components that explain a fraction of the variance, without holding all samples at once.

    Centred: about the weighted mean, with the divisor W - sum(w^2) / W (N - 1 for equal weights); else about zero, with
    W. Three methods, the first for which `memory_gb` suffices unless `method` names one:

    - samples: the N x N products of samples, which are held, if there are no more than D; exact
    - covariance: the D x D products of entries, float32 blocks summed in float64; exact to 3e-6
    - randomized: subspace iteration [Halko 2011] with as many additional vectors as components and two power
      iterations; needs `max_components`. Each pass reads the samples once.

    Args:
        samples: an iterable that can be read several times and gives the same samples each time.
        centred: subtract the mean.
        variance_ratio: fraction of the variance that the components must explain, at least.
        max_components: at most as many; None: any number.
        weights: of the samples, at least 0; None: ones.
        memory_gb: available for matrices.
        method: of the computation.
        seed: of the randomized method.

    Raises:
        ValueError: no samples, other than one weight each, or too little memory without `max_components`.
    """
    stream = _first_pass(samples, weights, centred)
    size = len(stream.mean)
    if method is None:
        method = _affordable(stream.count, size, memory_gb * 1e9)
    if method == "randomized" and max_components is None:
        raise ValueError(
            f"{stream.count} samples of {size} numbers need more than {memory_gb} GB; give `max_components`"
        )
    if method == "samples":
        variance, components = _by_samples(stream)
    elif method == "covariance":
        variance, components = _by_covariance(stream, max_components)
    else:
        assert max_components is not None
        variance, components = _by_sketch(stream, min(max_components, stream.count, size), seed)
    kept = _kept(variance, stream.total, variance_ratio, max_components)
    # As C = V diag(variance) V', the rows of sqrt(variance) V' are the components.
    components = components[:kept] * np.sqrt(variance[:kept])[:, None]
    return PrincipalComponents(
        mean=stream.mean,
        components=components * _signs(components)[:, None],
        variance=variance[:kept],
        total=stream.total,
        method=method,
    )


def _blocks(samples: Iterable[Float[np.ndarray, "D"]]) -> Iterator[tuple[int, Float[np.ndarray, "B D"]]]:
    """Stacks of float32 samples, each with the index of its first."""
    first, block = 0, []
    for sample in samples:
        block.append(np.asarray(sample, np.float32))
        if len(block) == _BLOCK:
            yield first, np.stack(block)
            first, block = first + _BLOCK, []
    if block:
        yield first, np.stack(block)


@dataclass(frozen=True, kw_only=True)
class _WeightedStream:
    """A stream whose blocks are rows sqrt(w / divisor) (x - mean), so that their products sum to the covariance."""

    samples: Iterable[Float[np.ndarray, "D"]]
    scale: Float[np.ndarray, "N"]
    mean: Float[np.ndarray, "D"]
    total: float
    count: int

    def __iter__(self) -> Iterator[Float[np.ndarray, "B D"]]:
        mean = self.mean.astype(np.float32)
        for first, block in _blocks(self.samples):
            block = block - mean
            block *= self.scale[first : first + len(block), None].astype(np.float32)
            yield block


def _first_pass(
    samples: Iterable[Float[np.ndarray, "D"]], weights: Float[np.ndarray, "N"] | None, centred: bool
) -> _WeightedStream:
    count, total, squares = 0, 0.0, np.zeros(0)
    mean = np.zeros(0)
    for first, block in _blocks(samples):
        block_weights = np.ones(len(block)) if weights is None else weights[first : first + len(block)]
        if len(block_weights) != len(block):
            raise ValueError("there are more samples than weights")
        if not count:
            mean, squares = np.zeros(block.shape[1]), np.zeros(block.shape[1])
        mean += block_weights @ block
        squares += block_weights @ np.square(block, dtype=np.float64)
        total += block_weights.sum()
        count += len(block)
    if not count or (weights is not None and len(weights) != count):
        raise ValueError(f"{count} samples" + ("" if weights is None else f" and {len(weights)} weights"))
    weights = np.ones(count) if weights is None else weights
    mean = mean / total if centred else np.zeros_like(mean)
    divisor = total - (weights**2).sum() / total if centred else total
    divisor = divisor if divisor > 0 else 1.0
    variance = float((squares - total * mean**2).sum()) / divisor
    scale = np.sqrt(weights / divisor)
    return _WeightedStream(samples=samples, scale=scale, mean=mean, total=max(variance, 0.0), count=count)


def _affordable(count: int, size: int, memory: float) -> Method:
    # An eigensolver needs twice the matrix in addition.
    if count <= size and 4 * count * size + 24 * count**2 <= memory:
        return "samples"
    return "covariance" if 28 * size**2 <= memory else "randomized"


def _by_samples(stream: _WeightedStream) -> tuple[Float[np.ndarray, "K"], Float[np.ndarray, "K D"]]:
    rows = np.concatenate(list(stream))
    products = np.zeros((len(rows), len(rows)))
    for first in range(0, rows.shape[1], 4096):  # float64 sums over float32 blocks
        block = rows[:, first : first + 4096].astype(np.float64)
        products += block @ block.T
    variance, vectors = _descending(*np.linalg.eigh(products))
    solid = variance > _MIN_VARIANCE * variance[0]
    return variance[solid], (vectors[:, solid].T @ rows) / np.sqrt(variance[solid])[:, None]


def _by_covariance(
    stream: _WeightedStream, max_components: int | None
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
    stream: _WeightedStream, components: int, seed: int
) -> tuple[Float[np.ndarray, "K"], Float[np.ndarray, "K D"]]:
    size = len(stream.mean)
    width = min(2 * components, size)
    basis = np.random.default_rng(seed).standard_normal((size, width), dtype=np.float32)
    for _ in range(1 + _POWER_ITERATIONS):
        image = np.zeros((size, width))
        for block in stream:
            image += block.T @ (block @ basis)
        basis = np.linalg.qr(image)[0].astype(np.float32)
    products = np.zeros((width, width))
    for block in stream:
        projections = (block @ basis).astype(np.float64)
        products += projections.T @ projections
    variance, vectors = _descending(*np.linalg.eigh(products))
    return variance[:components], vectors[:, :components].T @ basis.T.astype(np.float64)


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
