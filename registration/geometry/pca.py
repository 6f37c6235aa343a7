"""Principal components: of a small matrix in memory, or of samples that are read as a stream."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float
from scipy.linalg import eigh

_BLOCK = 64  # samples a block


def dense_components(
    samples: Float[np.ndarray, "N D"], share: float, *, centred: bool
) -> tuple[Float[np.ndarray, "K D"], Float[np.ndarray, "K"]]:
    """Return the fewest components that hold this share of the variance of samples in memory, in float64 throughout.

    The others read streams in float32 blocks. The first model is built with this one.

    Args:
        samples: fewer than D, since the N x N matrix of their products is decomposed.
        share: of the variance, 0 to 1.
        centred: about the mean, divided by N - 1; else about zero, divided by N.

    Returns:
        Components, each scaled by its standard deviation and with a positive largest entry, and standard deviations.
    """
    deviations = samples - samples.mean(0) if centred else samples
    count = len(samples) - 1 if centred else len(samples)
    variance, vectors = _descending(*np.linalg.eigh(deviations @ deviations.T / count))
    kept = int(np.searchsorted(np.cumsum(variance) / variance.sum(), share)) + 1
    components = vectors[:, :kept].T @ deviations / np.sqrt(count)
    largest = components[np.arange(kept), np.abs(components).argmax(1)]
    return components * np.sign(largest)[:, None], np.sqrt(variance[:kept])


def uncentred_components(
    samples: Iterable[Float[np.ndarray, "D"]], count: int, share: float
) -> tuple[Float[np.ndarray, "K D"], Float[np.ndarray, "N K"], Float[np.ndarray, "K"]]:
    """Components about zero that hold this share of the samples' energy, coefficients, and each one's share.

    Components are scaled by their standard deviation, so that coefficients have a mean square of one; the largest entry
    of each is positive, so that the result is unique. `samples` is read twice, `count` of them. Held in memory: the
    samples in float32 if there are fewer than D, else a D x D matrix of products, whichever is smaller. All zero:
    K = 0.
    """
    size = len(next(iter(samples)))
    products = _samples_products(samples, count) if count <= size else _entries_products(samples, size)
    variance, vectors = np.linalg.eigh(products / count)
    variance, vectors = np.maximum(variance[::-1], 0), vectors[:, ::-1]
    total = variance.sum()
    kept = int(np.searchsorted(np.cumsum(variance), share * total)) + 1 if total > 0 else 0
    deviation = np.sqrt(variance[:kept])
    if count <= size:
        coefficients = vectors[:, :kept] * np.sqrt(count)
        components = np.zeros((kept, size))
        for first, block in _blocks(samples):
            components += coefficients[first : first + len(block)].T @ block / count
    else:
        components = vectors[:, :kept].T * deviation[:, None]
        coefficients = np.concatenate([block @ vectors[:, :kept] / deviation for _, block in _blocks(samples)])
    sign = np.sign(components[np.arange(kept), np.abs(components).argmax(1)]) if kept else np.zeros(0)
    return components * sign[:, None], coefficients * sign, variance[:kept] / (total or 1)


def _samples_products(samples: Iterable[Float[np.ndarray, "D"]], count: int) -> Float[np.ndarray, "N N"]:
    rows = np.concatenate([block for _, block in _blocks(samples)])
    if len(rows) != count:
        raise ValueError(f"{len(rows)} samples where {count} were promised")
    products = np.zeros((count, count))
    for first in range(0, rows.shape[1], 4096):  # float64 sums over float32 blocks
        part = rows[:, first : first + 4096].astype(np.float64)
        products += part @ part.T
    return products


def _entries_products(samples: Iterable[Float[np.ndarray, "D"]], size: int) -> Float[np.ndarray, "D D"]:
    products = np.zeros((size, size))
    for _, block in _blocks(samples):
        products += block.T.astype(np.float64) @ block
    return products


def _blocks(samples: Iterable[Float[np.ndarray, "D"]]) -> Iterable[tuple[int, Float[np.ndarray, "B D"]]]:
    """Stacks of float32 samples, each with the number of its first."""
    first, block = 0, []
    for sample in samples:
        block.append(np.asarray(sample, np.float32))
        if len(block) == _BLOCK:
            yield first, np.stack(block)
            first, block = first + _BLOCK, []
    if block:
        yield first, np.stack(block)


Method = Literal["samples", "covariance", "randomized"]
_POWER_ITERATIONS = 2
_NOISE = 1e-11  # of the largest variance: below it is what rounding leaves


@dataclass(frozen=True, kw_only=True)
class Principal:
    """K principal components of a stream of samples, the strongest first, and how much of it they hold."""

    mean: Float[np.ndarray, "D"]  # of the samples; zero if they were not centred
    components: Float[np.ndarray, "K D"]  # orthogonal, each scaled by its standard deviation
    variance: Float[np.ndarray, "K"]
    total: float  # variance of all the samples
    method: Method

    @property
    def share(self) -> float:
        """Of the variance, kept."""
        return float(self.variance.sum() / self.total) if self.total > 0 else 1.0


def principal_components(
    samples: Iterable[Float[np.ndarray, "D"]],
    *,
    centred: bool,
    share: float = 1.0,
    most: int | None = None,
    weights: Float[np.ndarray, "N"] | None = None,
    memory_gb: float = 4.0,
    method: Method | None = None,
    seed: int = 0,
) -> Principal:
    """The fewest components that hold `share` of the variance, `most` at most, without holding all samples at once.

    Centred: about the weighted mean, the sum divided by W - sum(w^2) / W (N - 1 for equal weights); else about zero, by
    W. The largest entry of each component is positive. Three ways, the first that `memory_gb` allows unless `method`
    names one (docs/algorithms.md, "Principal components"):

    - samples: the N x N products of samples, which are held, if there are no more than D; exact
    - covariance: the D x D products of entries, float32 blocks summed in float64; exact to 3e-6
    - randomized: subspace iteration (Halko 2011) with as many more vectors as components and two power iterations;
      needs `most`. Each pass reads the samples once.

    Args:
        samples: an iterable that can be read several times and gives the same samples each time.
        weights: of the samples, at least 0; ones if None.

    Raises:
        ValueError: no samples, other than one weight each, or too little memory without `most`.
    """
    first = _first_pass(samples, weights, centred)
    size = len(first.mean)
    if method is None:
        method = _affordable(first.count, size, memory_gb * 1e9)
    if method == "randomized" and most is None:
        raise ValueError(f"{first.count} samples of {size} numbers need more than {memory_gb} GB; give `most`")
    if method == "samples":
        variance, components = _by_samples(first)
    elif method == "covariance":
        variance, components = _by_covariance(first, most)
    else:
        assert most is not None
        variance, components = _by_sketch(first, min(most, first.count, size), seed)
    kept = _kept(variance, first.total, share, most)
    # As C = V diag(variance) V', the rows of sqrt(variance) V' are the components.
    components = components[:kept] * np.sqrt(variance[:kept])[:, None]
    sign = np.sign(components[np.arange(kept), np.abs(components).argmax(1)]) if kept else np.zeros(0)
    return Principal(
        mean=first.mean,
        components=components * sign[:, None],
        variance=variance[:kept],
        total=first.total,
        method=method,
    )


@dataclass(frozen=True, kw_only=True)
class _Weighted:
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
) -> _Weighted:
    count, total, squares = 0, 0.0, np.zeros(0)
    mean = np.zeros(0)
    for first, block in _blocks(samples):
        own = np.ones(len(block)) if weights is None else weights[first : first + len(block)]
        if len(own) != len(block):
            raise ValueError("there are more samples than weights")
        if not count:
            mean, squares = np.zeros(block.shape[1]), np.zeros(block.shape[1])
        mean += own @ block
        squares += own @ np.square(block, dtype=np.float64)
        total += own.sum()
        count += len(block)
    if not count or (weights is not None and len(weights) != count):
        raise ValueError(f"{count} samples" + ("" if weights is None else f" and {len(weights)} weights"))
    given = np.ones(count) if weights is None else weights
    mean = mean / total if centred else np.zeros_like(mean)
    divisor = total - (given**2).sum() / total if centred else total
    scale = np.sqrt(given / (divisor if divisor > 0 else 1.0))
    variance = float((squares - total * mean**2).sum()) / (divisor if divisor > 0 else 1.0)
    return _Weighted(samples=samples, scale=scale, mean=mean, total=max(variance, 0.0), count=count)


def _affordable(count: int, size: int, memory: float) -> Method:
    # Beside the matrix an eigensolver needs as much twice.
    if count <= size and 4 * count * size + 24 * count**2 <= memory:
        return "samples"
    return "covariance" if 28 * size**2 <= memory else "randomized"


def _by_samples(stream: _Weighted) -> tuple[Float[np.ndarray, "K"], Float[np.ndarray, "K D"]]:
    rows = np.concatenate(list(stream))
    products = np.zeros((len(rows), len(rows)))
    for first in range(0, rows.shape[1], 4096):
        part = rows[:, first : first + 4096].astype(np.float64)
        products += part @ part.T
    variance, vectors = _descending(*np.linalg.eigh(products))
    solid = variance > _NOISE * variance[0]
    return variance[solid], (vectors[:, solid].T @ rows) / np.sqrt(variance[solid])[:, None]


def _by_covariance(stream: _Weighted, most: int | None) -> tuple[Float[np.ndarray, "K"], Float[np.ndarray, "K D"]]:
    size = len(stream.mean)
    products = np.zeros((size, size))
    for block in stream:
        products += block.T @ block
    wanted = None if most is None or most >= size else (size - most, size - 1)
    variance, vectors = _descending(*eigh(products, subset_by_index=wanted, overwrite_a=True, check_finite=False))
    solid = variance > _NOISE * variance[0]
    return variance[solid], vectors[:, solid].T


def _by_sketch(stream: _Weighted, most: int, seed: int) -> tuple[Float[np.ndarray, "K"], Float[np.ndarray, "K D"]]:
    size = len(stream.mean)
    wide = min(2 * most, size)
    basis = np.random.default_rng(seed).standard_normal((size, wide), dtype=np.float32)
    for _ in range(1 + _POWER_ITERATIONS):
        image = np.zeros((size, wide))
        for block in stream:
            image += block.T @ (block @ basis)
        basis = np.linalg.qr(image)[0].astype(np.float32)
    products = np.zeros((wide, wide))
    for block in stream:
        inside = (block @ basis).astype(np.float64)
        products += inside.T @ inside
    variance, vectors = _descending(*np.linalg.eigh(products))
    return variance[:most], vectors[:, :most].T @ basis.T.astype(np.float64)


def _descending(
    variance: Float[np.ndarray, "K"], vectors: Float[np.ndarray, "D K"]
) -> tuple[Float[np.ndarray, "K"], Float[np.ndarray, "D K"]]:
    return np.maximum(variance[::-1], 0), vectors[:, ::-1]


def _kept(variance: Float[np.ndarray, "K"], total: float, share: float, most: int | None) -> int:
    solid = int((variance > _NOISE * variance.max(initial=0)).sum())
    enough = int(np.searchsorted(np.cumsum(variance), share * total)) + 1 if total > 0 else 0
    return min(enough, solid, len(variance) if most is None else most)
