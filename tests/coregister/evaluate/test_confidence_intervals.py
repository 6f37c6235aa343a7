"""Bootstrap intervals over subjects: coverage, pairing, and subjects without a value."""

import numpy as np
import pytest

from coregister.evaluate.confidence_intervals import bootstrap_interval, bootstrap_statistic_interval


@pytest.mark.parametrize("subjects", [8, 30])
def test_coverage_of_a_known_mean(subjects):
    rng = np.random.default_rng(0)
    trials = 600
    covered = 0
    for trial in range(trials):
        interval = bootstrap_interval(rng.normal(1.0, 0.3, subjects), seed=trial, draws=1000)
        covered += interval.low <= 1.0 <= interval.high
    # 95 %, with a standard deviation of 0.9 % by the number of trials; slightly less for few subjects.
    assert 0.92 <= covered / trials <= 0.975


def test_width_depends_on_deviation_and_number_of_subjects():
    rng = np.random.default_rng(1)
    values = rng.normal(0, 1, 400)

    def width(values):
        interval = bootstrap_interval(values, seed=0)
        return interval.high - interval.low

    assert width(2 * values) == pytest.approx(2 * width(values))
    assert width(values) == pytest.approx(2 * 1.96 * values.std() / 20, rel=0.08)
    assert 1.7 < width(values[:100]) / width(values) < 2.3


def test_subjects_without_a_value_are_excluded():
    values = np.array([1.0, 2.0, 3.0, np.nan])
    assert bootstrap_interval(values, seed=3) == bootstrap_interval(values[:3], seed=3)
    with pytest.raises(ValueError):
        bootstrap_interval(np.array([np.nan]), seed=0)


def test_one_subject_has_a_mean_and_no_interval():
    interval = bootstrap_interval(np.array([0.7]), seed=0)
    assert (interval.mean, interval.low, interval.high) == (0.7, None, None)


def test_columns_are_resampled_in_pairs():
    rng = np.random.default_rng(2)
    distance = rng.uniform(0.5, 3.0, 20)  # subjects differ much more than models
    pairs = np.stack([distance, 0.8 * distance], 1)
    gain = bootstrap_statistic_interval(pairs, lambda means: 1 - means[..., 1] / means[..., 0], seed=0)
    assert gain.mean == pytest.approx(0.2)
    assert gain.high - gain.low < 1e-12
