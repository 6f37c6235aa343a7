"""The penalty separates parts that intersect, and nothing else moves much; see also `bench/self_intersection.py`."""

import numpy as np
import pytest
import torch

from bench.support.crossed_parts import (
    cheeks,
    eyeball_depths_mm,
    lip_depths_mm,
    pressed_lid,
    raised_lower_lip,
    recover,
)
from registration.model import gnm_npz, regions
from registration.model.gnm_npz import GNMData
from tests.conftest import SHARED, needs_shared

pytestmark = needs_shared


@pytest.fixture(scope="module")
def data() -> GNMData:
    return gnm_npz.read(SHARED / "data" / "gnm" / "gnm_head_reconstructed.npz")


def test_crossed_lips_are_separated(data):
    rest = lip_depths_mm(data, torch.as_tensor(data.template_vertex_positions))
    recovery = recover(data, raised_lower_lip(data, 2.0), steps=100, rate=2e-4)
    assert (lip_depths_mm(data, recovery.before) - rest).max() > 1.2
    assert (lip_depths_mm(data, recovery.after) - rest).max() < 0.1
    assert recovery.max_motion_mm(cheeks(data)) < 0.3
    assert recovery.max_motion_mm(np.logical_or(*regions.lips(data))) < 2.5


def test_an_eyelid_is_moved_out_of_the_eyeball_and_no_further(data):
    rest = eyeball_depths_mm(data, torch.as_tensor(data.template_vertex_positions))
    recovery = recover(data, pressed_lid(data, 1.0), steps=60, rate=4e-5)
    pressed, freed = (eyeball_depths_mm(data, vertices) for vertices in (recovery.before, recovery.after))
    assert (pressed - rest).max() > 0.7 and (freed - rest).max() < 0.1
    # Vertices in the eyeball at rest remain there: contact is no intersection.
    assert (freed > 0.1).sum() > 0.8 * (rest > 0.1).sum()
    assert recovery.max_motion_mm(regions.exterior(data)) < 1.3 and recovery.max_motion_mm(cheeks(data)) < 0.05
