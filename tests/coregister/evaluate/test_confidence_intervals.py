"""Intervals over subjects: they hold the truth as often as they promise, and count subjects, not samples."""

import numpy as np
import pytest

from coregister.evaluate.confidence_intervals import bootstrap_interval, bootstrap_statistic_interval


@pytest.mark.parametrize("subjects", [8, 30])
def test_intervals_hold_a_known_mean(subjects):
    rng = np.random.default_rng(0)
    trials = 600
    held = 0
    for trial in range(trials):
        found = bootstrap_interval(rng.normal(1.0, 0.3, subjects), seed=trial, draws=1000)
        held += found.low <= 1.0 <= found.high
    assert 0.92 <= held / trials <= 0.975  # 95 %, give or take the trials' own 1.8 % and what few subjects cost


def test_a_wider_spread_makes_a_wider_interval_and_more_subjects_a_narrower_one():
    rng = np.random.default_rng(1)
    values = rng.normal(0, 1, 400)

    def width(values):
        found = bootstrap_interval(values, seed=0)
        return found.high - found.low

    assert width(2 * values) == pytest.approx(2 * width(values))
    assert width(values) == pytest.approx(2 * 1.96 * values.std() / 20, rel=0.08)
    assert 1.7 < width(values[:100]) / width(values) < 2.3


def test_subjects_without_a_value_do_not_count():
    values = np.array([1.0, 2.0, 3.0, np.nan])
    assert bootstrap_interval(values, seed=3) == bootstrap_interval(values[:3], seed=3)
    with pytest.raises(ValueError):
        bootstrap_interval(np.array([np.nan]), seed=0)


def test_one_subject_has_a_mean_and_no_interval():
    found = bootstrap_interval(np.array([0.7]), seed=0)
    assert (found.mean, found.low, found.high) == (0.7, None, None)


def test_pairs_stay_pairs():
    rng = np.random.default_rng(2)
    hard = rng.uniform(0.5, 3.0, 20)  # subjects differ far more than models do
    both = np.stack([hard, 0.8 * hard], 1)
    gain = bootstrap_statistic_interval(both, lambda means: 1 - means[..., 1] / means[..., 0], seed=0)
    assert gain.mean == pytest.approx(0.2)
    assert gain.high - gain.low < 1e-12
