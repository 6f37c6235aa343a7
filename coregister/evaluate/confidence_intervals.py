"""Confidence intervals of means over subjects: bootstrap over subjects, never over samples [Hesterberg 2015].

Samples of one subject are correlated, so that resampling them would make intervals too narrow. Every subject has one
value, whatever the number of its samples; docs/algorithms.md, "Confidence intervals".
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.stats import norm, t

LEVEL = 0.95
DRAWS = 2000


@dataclass(frozen=True, kw_only=True)
class Interval:
    """A mean and its 95 % confidence interval; `low` and `high` are None for one subject."""

    mean: float
    low: float | None
    high: float | None


def bootstrap_interval(values: Float[np.ndarray, "N"], *, seed: int, draws: int = DRAWS) -> Interval:
    """Return the interval of the mean of one value per subject.

    Args:
        values: of the subjects; NaN: the subject has none and is excluded.
        seed: of the resampling.
        draws: number of resamples.

    Raises:
        ValueError: no subject has a value.
    """
    return bootstrap_statistic_interval(values[:, None], lambda means: means[..., 0], seed=seed, draws=draws)


def bootstrap_statistic_interval(
    values: Float[np.ndarray, "N C"],
    statistic: Callable[[Float[np.ndarray, "*B C"]], Float[np.ndarray, "*B"]],
    *,
    seed: int,
    draws: int = DRAWS,
) -> Interval:
    """Return the interval of a statistic of the columns' means. All columns have the same resamples: paired.

    Expanded percentiles [Hesterberg 2015]: plain percentiles are too narrow for few subjects, since they lack the
    factor n / (n - 1) and the heavier tails of Student's distribution.

    Args:
        values: a row a subject; rows with a NaN are excluded.
        statistic: of the columns' means, vectorized.
        seed: of the resampling.
        draws: number of resamples.

    Raises:
        ValueError: every row has a NaN.
    """
    complete = values[np.isfinite(values).all(1)]
    count = len(complete)
    if not count:
        raise ValueError("an interval needs at least one subject with a value")
    mean = float(statistic(complete.mean(0)))
    if count == 1:
        return Interval(mean=mean, low=None, high=None)
    rng = np.random.default_rng(seed)
    weights = rng.multinomial(count, np.full(count, 1 / count), size=draws) / count
    tail = norm.cdf(np.sqrt(count / (count - 1)) * t.ppf((1 - LEVEL) / 2, count - 1))
    low, high = np.quantile(statistic(weights @ complete), [tail, 1 - tail])
    return Interval(mean=mean, low=float(low), high=float(high))
