"""The opening of the eyelids that `python -m bench.lids` prints."""

import numpy as np
import pytest

from bench.lids import LIDS, opening_mm
from registration.model.landmarks import LandmarkScheme


@pytest.mark.parametrize(("upper_mm", "expected_mm"), [(8.0, 5.0), (3.0, 0.0), (0.0, -3.0)])
def test_the_opening_of_lids_that_overlap_is_negative(upper_mm: float, expected_mm: float):
    points = np.zeros((478, 3))
    points[10, 1], points[152, 1] = 0.1, -0.1  # forehead and chin
    upper, lower = LIDS["left"]
    points[list(upper), 1], points[list(lower), 1] = 1e-3 * upper_mm, 3e-3
    scheme = LandmarkScheme(
        name="points", indices=np.repeat(np.arange(478)[:, None], 3, 1), weights=np.full((478, 3), 1 / 3)
    )
    turned = points @ np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])
    assert opening_mm(scheme, turned, "left") == pytest.approx(expected_mm)
