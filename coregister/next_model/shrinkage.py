"""Few registrations and the previous model's basis as one stream of samples."""

from collections.abc import Iterable, Iterator

import numpy as np
from jaxtyping import Float


class Mixed:
    """Rows whose mean square is (1 - p) C + p (tr C / tr P) P: to be read again and again by `geometry.pca`.

    C = sum w x x' / divisor over the samples, P = B'B of the previous model's components, which are scaled by standard
    deviations: what ever more samples of that model would tend to, without a seed. The variance in all is the samples',
    of which the share p looks as the previous model's. Without previous components p is 0.
    """

    def __init__(
        self,
        samples: Iterable[Float[np.ndarray, "D"]],
        weights: Float[np.ndarray, "N"],
        divisor: float,
        previous: Float[np.ndarray, "K D"],
        share: float,
    ):
        self._samples = samples
        energy = sum(w * float(x.astype(np.float64) @ x) for w, x in zip(weights, samples, strict=True)) / divisor
        other = float((previous**2).sum())
        self.share = share if other > 0 and energy > 0 else 0.0
        self._previous = previous if self.share > 0 else previous[:0]
        count = len(weights) + len(self._previous)
        self._own = np.sqrt((1 - self.share) * count * weights / divisor)
        self._other = np.sqrt(self.share * count * energy / other) if self.share > 0 else 0.0

    def __iter__(self) -> Iterator[Float[np.ndarray, "D"]]:
        for scale, sample in zip(self._own, self._samples, strict=True):
            yield scale * sample
        for component in self._previous:
            yield self._other * component
