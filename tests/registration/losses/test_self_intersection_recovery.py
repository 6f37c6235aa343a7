"""The penalty separates parts that intersect, and nothing else moves much; see also `bench/self_intersection.py`."""

import numpy as np

from bench.support.crossed_parts import cheeks, eyeball_depths_mm, lip_depths_mm, recover
from registration.model import regions
from tests.registration.losses.crossings import CROSSINGS, push_until


def test_crossed_lips_are_separated(any_model):
    crossed = push_until(any_model, CROSSINGS["upper-lower lip"], 1.3)
    recovery = recover(any_model, crossed.vertices, steps=100, rate=2e-4)
    assert (lip_depths_mm(any_model, recovery.after) - crossed.rest_mm).max() < 0.1
    assert recovery.max_motion_mm(cheeks(any_model)) < 0.05
    assert recovery.max_motion_mm(np.logical_or(*regions.lips(any_model))) < 2.5


def test_an_eyelid_is_moved_out_of_the_eyeball_and_no_further(any_model):
    crossed = push_until(any_model, CROSSINGS["lids-eyeballs"], 0.8)
    recovery = recover(any_model, crossed.vertices, steps=60, rate=4e-5)
    rest, freed = crossed.rest_mm, eyeball_depths_mm(any_model, recovery.after)
    assert (freed - rest).max() < 0.1
    # Vertices in the eyeball at rest remain there: contact is no intersection.
    assert (freed > 0.1).sum() >= 0.8 * (rest > 0.1).sum()
    assert recovery.max_motion_mm(regions.exterior(any_model)) < 1.3
    assert recovery.max_motion_mm(cheeks(any_model)) < 0.05
