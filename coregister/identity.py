"""Identity basis: centred principal components of aligned neutral heads (paper, Head Identity)."""

import numpy as np
from jaxtyping import Float


def principal_components(
    samples: Float[np.ndarray, "N D"], share: float, *, centred: bool
) -> tuple[Float[np.ndarray, "K D"], Float[np.ndarray, "K"]]:
    """Components that keep this share of the samples' variance, each scaled by its standard deviation, and those.

    Centred: about the mean, divided by N - 1; uncentred: about zero, divided by N. Exact, by the N x N Gram matrix,
    which is the smaller one here. The largest entry of every component is positive, so the result is unique.
    """
    moved = samples - samples.mean(0) if centred else samples
    count = len(samples) - 1 if centred else len(samples)
    variance, vectors = np.linalg.eigh(moved @ moved.T / count)
    variance, vectors = np.maximum(variance[::-1], 0), vectors[:, ::-1]
    kept = int(np.searchsorted(np.cumsum(variance) / variance.sum(), share)) + 1
    scaled = vectors[:, :kept].T @ moved / np.sqrt(count)
    largest = scaled[np.arange(kept), np.abs(scaled).argmax(1)]
    return scaled * np.sign(largest)[:, None], np.sqrt(variance[:kept])
