"""Eight known factors within 20 classes: how many dimensions are in use, and the classes' covariances."""

import time
from collections.abc import Iterator

import numpy as np

from bench.sampler_checks import BenchOptions, Figure
from coregister.sampler.loss import KLSchedule
from coregister.sampler.metrics import NetworkMetrics, measure
from coregister.sampler.networks import EXPRESSION_LAYERS
from coregister.sampler.samples import CoefficientSet, coefficient_set, split_by_subject
from coregister.sampler.training import TrainingSettings, train

CLASSES, FACTORS, SIZE = 20, 8, 100
MIN_ACTIVE, WITHIN = 6, 0.15


def samples(count: int, seed: int) -> CoefficientSet:
    """Class means plus eight factors of falling strength, with a little noise."""
    rng = np.random.default_rng([37, seed])
    means = rng.normal(size=(CLASSES, SIZE))
    directions = 0.5 * rng.normal(size=(FACTORS, SIZE)) * np.linspace(1, 0.4, FACTORS)[:, None]
    classes = np.arange(count) % CLASSES
    values = means[classes] + rng.normal(size=(count, FACTORS)) @ directions + 0.02 * rng.normal(size=(count, SIZE))
    names = [(f"class {k:02d}",) for k in classes]
    return coefficient_set(values, names, ("expression",), [str(k) for k in range(count)], "factors")


def trained_metrics(options: BenchOptions, weight: float) -> tuple[NetworkMetrics, float]:
    """Train and measure; also the duration of the training, s."""
    training, held_out = split_by_subject(samples(options.count, options.seed), options.seed)
    settings = TrainingSettings(steps=options.steps, schedule=KLSchedule(weight=weight), seed=options.seed)
    begin = time.perf_counter()
    trained = train(training, held_out, EXPRESSION_LAYERS, settings)
    seconds = time.perf_counter() - begin
    return measure(trained, training, held_out, options.seed), seconds


def figures(options: BenchOptions) -> Iterator[Figure]:
    found, seconds = trained_metrics(options, KLSchedule().weight)
    yield Figure(name="training", value=f"{seconds:.0f} s for {options.steps} steps")
    active = found.active_units
    yield Figure(name="active units", value=str(active), limit=f">= {MIN_ACTIVE}", kept=active >= MIN_ACTIVE)
    ratios = [part.variance_ratio or 0.0 for part in found.classes.values()]
    worst = max(abs(ratio - 1) for ratio in ratios)
    value = f"{min(ratios):.3f} to {max(ratios):.3f} of the samples', mean {np.mean(ratios):.3f}"
    limit = f"within {WITHIN:.0%}, each class"
    yield Figure(name="trace of the class covariance", value=value, limit=limit, kept=worst <= WITHIN)
    yield Figure(name="variance of class means", value=f"{found.between_draws / found.between:.3f} of the samples'")
    yield Figure(name="class accuracy of draws", value=f"{found.accuracy['expression']:.4f}")
    mmd = [part.mmd or 0.0 for part in found.classes.values()]
    halves = [part.mmd_halves or 0.0 for part in found.classes.values()]
    value = f"{np.mean(mmd):.4f}, largest {np.max(mmd):.4f}; halves of the samples {np.mean(halves):.4f}"
    yield Figure(name="squared MMD per class", value=value)
    yield Figure(name="KL", value=f"{sum(found.kl):.1f} nats")
    yield Figure(name="status", value=found.status, limit="trained", kept=found.status == "trained")
