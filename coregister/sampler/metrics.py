"""How well draws have the distribution of the training samples, by class, and whether a posterior collapsed."""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float

from coregister.sampler.categories import one_hot
from coregister.sampler.classifier import fit_classifier
from coregister.sampler.loss import divergences
from coregister.sampler.samples import CoefficientSet
from coregister.sampler.training import TrainedNetwork

DRAWS = 200  # of each class
MAX_CLASSES = 64  # combinations of categories that are measured, the most frequent ones
# Variance of a latent dimension's posterior mean within classes above which it is in use [Burda 2016]; an idle one has
# up to 0.04, which the free bits allow.
ACTIVE = 0.1
COLLAPSED = 0.25  # share of the variance within classes: draws with less have lost what varies within a class
_MMD_SAMPLES = 300

NetworkStatus = Literal["trained", "collapsed"]


@dataclass(frozen=True, kw_only=True)
class ClassMetrics:
    """Draws of one class compared with its samples."""

    samples: int
    variance_ratio: float | None  # trace of the draws' covariance over the samples'; None: equal samples
    mmd: float | None  # squared maximum mean discrepancy of draws and samples, unbiased; None: too few samples
    mmd_halves: float | None  # the same between two halves of the samples: what equal distributions have


@dataclass(frozen=True, kw_only=True)
class NetworkMetrics:
    """The figures of a network's report."""

    status: NetworkStatus
    reason: str
    active_units: int
    kl: tuple[float, ...]  # nats, by latent dimension
    within: float  # trace of the covariance within classes, of the samples
    within_draws: float
    between: float  # trace of the covariance of class means, of the samples
    between_draws: float
    accuracy: dict[str, float]  # factor -> share of draws that the classifier puts into their category
    accuracy_held_out: dict[str, float]  # the same of held-out samples: what can be reached
    classes: dict[str, ClassMetrics]  # "female, asian" -> its figures


def measure(trained: TrainedNetwork, samples: CoefficientSet, held_out: CoefficientSet, seed: int) -> NetworkMetrics:
    """Draw from a network and compare.

    Args:
        trained: the network.
        samples: that it was trained on.
        held_out: of other subjects; may be empty.
        seed: of the draws.
    """
    rng = np.random.default_rng([23, seed])
    mean, log_variance = trained.posterior(samples)
    variance_of_mean = _within(mean.numpy(), samples)
    members = samples.classes
    frequent = sorted(members, key=lambda name: -int(members[name].sum()))[:MAX_CLASSES]
    categories = np.repeat([samples.categories[members[name]][0] for name in frequent], DRAWS, axis=0)
    latent = rng.standard_normal((len(categories), trained.network.architecture.latent))
    draws = CoefficientSet(
        coefficients=trained.decoder(samples.factors).decode(latent, one_hot(categories, samples.factors)),
        categories=categories,
        factors=samples.factors,
        subjects=("",) * len(categories),
    )
    kept = np.any([members[name] for name in frequent], axis=0)
    real = samples.rows(kept)
    within, within_draws = _within(real.coefficients, real).sum(), _within(draws.coefficients, draws).sum()
    active = int((variance_of_mean > ACTIVE).sum())
    status, reason = _judged(float(within), float(within_draws), active)
    drawn, held = draws.classes, held_out.classes
    return NetworkMetrics(
        status=status,
        reason=reason,
        active_units=active,
        kl=tuple(divergences(mean, log_variance).tolist()),
        within=float(within),
        within_draws=float(within_draws),
        between=_between(real),
        between_draws=_between(draws),
        accuracy=accuracies(samples, draws),
        accuracy_held_out=accuracies(samples, held_out) if len(held_out.coefficients) else {},
        classes={
            ", ".join(name): _class_metrics(
                samples.coefficients[members[name]],
                draws.coefficients[drawn[name]],
                held_out.coefficients[held[name]] if name in held else held_out.coefficients[:0],
                rng,
            )
            for name in frequent
        },
    )


def accuracies(samples: CoefficientSet, tested: CoefficientSet) -> dict[str, float]:
    """Return the share of tested samples whose category a classifier finds, by factor; fitted to other samples."""
    found = {}
    for k, factor in enumerate(samples.factors):
        classifier = fit_classifier(samples.coefficients, samples.categories[:, k], len(factor.categories))
        right = classifier.predict(tested.coefficients) == tested.categories[:, k]
        found[factor.name] = float(right.mean())
    return found


def _judged(within: float, within_draws: float, active: int) -> tuple[NetworkStatus, str]:
    """Whether the posterior collapsed, and what to change."""
    if within <= 0 or (within_draws >= COLLAPSED * within and active > 0):
        return "trained", ""
    return "collapsed", (
        f"the posterior collapsed: {active} latent dimensions are in use, and draws have "
        f"{within_draws / within:.0%} of the variance within classes. Lower the KL weight (--kl-weight), train longer "
        "(--steps), or give more samples of each category"
    )


def _within(values: Float[np.ndarray, "N K"], samples: CoefficientSet) -> Float[np.ndarray, "K"]:
    """Return the variance within classes, the mean over samples; classes of one sample are left out."""
    total, count = np.zeros(values.shape[1]), 0
    for members in samples.classes.values():
        own = values[members].astype(np.float64)
        if len(own) > 1:
            total += len(own) * own.var(0, ddof=1)
            count += len(own)
    return total / max(count, 1)


def _between(samples: CoefficientSet) -> float:
    means = np.stack([samples.coefficients[members].mean(0, dtype=np.float64) for members in samples.classes.values()])
    return float(means.var(0).sum())


def _class_metrics(
    samples: Float[np.ndarray, "N D"],
    draws: Float[np.ndarray, "M D"],
    held_out: Float[np.ndarray, "K D"],
    rng: np.random.Generator,
) -> ClassMetrics:
    real = np.concatenate([samples, held_out])
    variance = float(samples.var(0, ddof=1).sum()) if len(samples) > 1 else 0.0
    chosen = real[rng.permutation(len(real))[:_MMD_SAMPLES]]
    halves = len(chosen) // 2
    enough = halves >= 4
    return ClassMetrics(
        samples=len(samples),
        variance_ratio=float(draws.var(0, ddof=1).sum()) / variance if variance > 0 else None,
        mmd=squared_mmd(chosen, draws) if enough else None,
        mmd_halves=squared_mmd(chosen[:halves], chosen[halves:]) if enough else None,
    )


def squared_mmd(a: Float[np.ndarray, "N D"], b: Float[np.ndarray, "M D"]) -> float:
    """Return the unbiased squared maximum mean discrepancy [Gretton 2012].

    The kernel is a Gaussian of the median distance. 0 for equal distributions, with chance on both sides; up to 2.
    """
    both = np.concatenate([a, b]).astype(np.float64)
    squared = (both**2).sum(1)
    distances = np.maximum(squared[:, None] + squared - 2 * both @ both.T, 0)
    width = np.median(distances[np.triu_indices(len(both), 1)])
    kernel = np.exp(-distances / max(float(width), 1e-12))
    n, m = len(a), len(b)
    inside = [(part.sum() - np.trace(part)) / (k * (k - 1)) for part, k in ((kernel[:n, :n], n), (kernel[n:, n:], m))]
    return float(sum(inside) - 2 * kernel[:n, n:].mean())
