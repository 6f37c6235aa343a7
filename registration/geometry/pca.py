"""Principal components of samples that are read as a stream, exact."""

from collections.abc import Iterable

import numpy as np
from jaxtyping import Float

_BLOCK = 64  # samples a block


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
