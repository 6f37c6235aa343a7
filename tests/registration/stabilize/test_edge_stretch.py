"""The stretch of edges where a component is dropped, for motions with a known answer."""

from dataclasses import replace

import numpy as np
import pytest

from registration.stabilize.components import HeadGeometry, RegionalComponents, regional_components
from registration.stabilize.decisions import dropped_displacement
from registration.stabilize.edge_stretch import EdgeStretch, drop_stretch, skin_edges


@pytest.fixture(scope="module")
def part(head: HeadGeometry) -> RegionalComponents:
    """The nose's component of two samples, translations of the whole head by 1 mm, there and back."""
    shift = np.zeros_like(head.points)
    shift[:, 2] = 1e-3
    components = regional_components([shift, -shift], ["a", "b"], head)
    return next(part for part in components if part.region == "nose")


def stretch(part: RegionalComponents, head: HeadGeometry, moves_mm: float) -> EdgeStretch:
    """Of a component that moves the whole head forwards."""
    modes = np.zeros_like(part.modes)
    modes[..., 2] = 1e-3 * moves_mm
    along = np.zeros((1, *head.points.shape))
    along[..., 2] = 1e-3 * moves_mm
    return drop_stretch(replace(part, modes=modes), 0, {"nose": along}, head, skin_edges(head))


def test_edges_are_those_of_the_exterior_skin(head: HeadGeometry) -> None:
    pairs = skin_edges(head)
    assert len(pairs) > 10_000 and (head.area[pairs] > 0).all() and len(np.unique(np.sort(pairs), axis=0)) == len(pairs)


def test_a_small_motion_stretches_little(part: RegionalComponents, head: HeadGeometry) -> None:
    """The motion fades over 10 mm, by at most 1.5 times its size per 10 mm."""
    found = stretch(part, head, 1.0)
    assert 1.0 < found.ratio < 1.15 and not found.tears


def test_a_large_motion_tears_the_skin_around_the_region(part: RegionalComponents, head: HeadGeometry) -> None:
    found = stretch(part, head, 30.0)
    assert found.tears and found.ratio > 2 and found.longer_mm > 0.5
    assert np.isin(found.torn, part.rows).any(1).all()  # not in the rest of the head, which keeps its motion


def test_what_the_samples_already_have_is_no_stretch(part: RegionalComponents, head: HeadGeometry) -> None:
    """Dropping a motion that only the region has removes the stretch at its border."""
    pairs, modes = skin_edges(head), np.zeros_like(part.modes)
    modes[..., 2] = 30e-3
    moved = replace(part, modes=modes)
    along = np.zeros((1, *head.points.shape))
    along[0] = dropped_displacement(moved, 0, head)
    found = drop_stretch(moved, 0, {"nose": along}, head, pairs)
    assert found.ratio == pytest.approx(1.0, abs=1e-6) and not found.tears
