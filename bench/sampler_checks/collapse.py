"""A KL weight of 100 instead of 0.05: the posterior collapses, and the alarm says so."""

from collections.abc import Iterator

from bench.sampler_checks import BenchOptions, Figure
from bench.sampler_checks.factors import trained_metrics

WEIGHT = 100.0


def figures(options: BenchOptions) -> Iterator[Figure]:
    found, _ = trained_metrics(options, WEIGHT)
    yield Figure(name="status", value=found.status, limit="collapsed", kept=found.status == "collapsed")
    yield Figure(name="active units", value=str(found.active_units))
    yield Figure(name="variance within classes", value=f"{found.within_draws / found.within:.4f} of the samples'")
    yield Figure(name="reason", value=found.reason)
