"""Means over subjects and how far they can be trusted: intervals by bootstrap over subjects, never over samples.

Samples of one subject resemble one another, so that counting each would promise too much. A subject counts once,
however many samples it has.
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
    """A mean and its 95 % interval; `low` and `high` are None where one subject alone tells nothing of others."""

    mean: float
    low: float | None
    high: float | None


def interval(values: Float[np.ndarray, "N"], *, seed: int, draws: int = DRAWS) -> Interval:
    """The mean of one value per subject; subjects whose value is NaN do not count.

    Raises:
        ValueError: no subject has a value.
    """
    return interval_of(values[:, None], lambda sums: sums[..., 0], seed=seed, draws=draws)


def interval_of(
    values: Float[np.ndarray, "N C"],
    statistic: Callable[[Float[np.ndarray, "*B C"]], Float[np.ndarray, "*B"]],
    *,
    seed: int,
    draws: int = DRAWS,
) -> Interval:
    """A statistic of the columns' means, the same subjects drawn for all columns: paired.

    Expanded percentiles (Hesterberg, What Teachers Should Know About the Bootstrap, 2015): plain ones are too narrow
    for a few subjects, for they leave out the factor n / (n - 1) and Student's heavier tails. Rows with a NaN do not
    count.

    Raises:
        ValueError: no row is without NaN.
    """
    known = values[np.isfinite(values).all(1)]
    count = len(known)
    if not count:
        raise ValueError("an interval needs at least one subject with a value")
    mean = float(statistic(known.mean(0)))
    if count == 1:
        return Interval(mean=mean, low=None, high=None)
    rng = np.random.default_rng(seed)
    shares = rng.multinomial(count, np.full(count, 1 / count), size=draws) / count
    tail = norm.cdf(np.sqrt(count / (count - 1)) * t.ppf((1 - LEVEL) / 2, count - 1))
    low, high = np.quantile(statistic(shares @ known), [tail, 1 - tail])
    return Interval(mean=mean, low=float(low), high=float(high))
