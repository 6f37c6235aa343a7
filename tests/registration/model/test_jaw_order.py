import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from registration.model.jaw_order import TURNED, is_reversed
from registration.model.landmarks import read_scheme
from tests.fixtures.make_fixtures import HERE, tiny_model

TEMPLATE = tiny_model().template_vertex_positions
POINTS = read_scheme(HERE / "head_sparse_68.txt", TEMPLATE).points(TEMPLATE.astype(np.float64))


def test_turning_is_its_own_inverse():
    np.testing.assert_array_equal(np.arange(68)[TURNED][TURNED], np.arange(68))
    np.testing.assert_array_equal(np.flatnonzero(TURNED != np.arange(68)), [2, 3, 5, 6])
    np.testing.assert_array_equal(TURNED[2:7], [6, 5, 4, 3, 2])


@settings(max_examples=60, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    scale=st.floats(1e-3, 1e3),
    noise=st.floats(0, 3e-3),
    lost=st.lists(st.integers(0, 16), max_size=4),
)
def test_the_order_is_told_under_any_similarity_noise_and_gaps(seed, scale, noise, lost):
    rng = np.random.default_rng(seed)
    points = POINTS + rng.normal(size=POINTS.shape) * noise
    points = scale * points @ Rotation.random(random_state=seed % 2**31).as_matrix().T + rng.normal(size=3)
    first, second = points.copy(), points[TURNED]
    first[lost] = second[lost] = np.nan
    known = {*range(2, 7)} - {*lost}
    assert not is_reversed(first)
    assert is_reversed(second) == (len(known) > 1) or len(known) < 4  # few points may be told, but need not
    if len(known) < 2:
        assert not is_reversed(second)


@pytest.mark.parametrize("points", [np.zeros((0, 3)), np.zeros((5, 3)), np.zeros((68, 3)), np.full((68, 3), np.nan)])
def test_other_points_are_in_no_such_order(points):
    assert not is_reversed(points)


def test_other_disorders_are_left_alone():
    for order in (np.r_[16:-1:-1, 17:68], np.r_[0:10, 14:9:-1, 15:68]):  # from left to right; the left jaw reversed
        assert not is_reversed(POINTS[order])
