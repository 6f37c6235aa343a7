from dataclasses import replace

import numpy as np
import pytest

from registration.anatomy.tongue_structure import find_tongue
from registration.errors import InputError
from registration.geometry.topology import boundary_vertices
from registration.model import gnm_npz, regions
from tests.conftest import SHARED, needs_shared
from tests.fixtures.make_fixtures import HERE


@pytest.fixture(scope="module")
def tiny():
    return gnm_npz.read(HERE / "tiny_gnm.npz")


def test_an_ellipsoid_has_its_tip_in_front_and_an_axis_through_its_middle(tiny):
    tongue = find_tongue(tiny)
    points = tiny.template_vertex_positions[regions.tongue(tiny)]
    length = np.ptp(points[:, 2])
    assert tongue.rest[tongue.tip, 2] == points[:, 2].max()
    assert tongue.length == pytest.approx(length, rel=0.1)
    assert tongue.axis == pytest.approx([0, 0, 1], abs=0.05)
    inner = (tongue.stations > 0.2) & (tongue.stations < 0.9)
    assert np.abs(tongue.centre[inner, 1] - points[:, 1].mean()).max() < 0.05 * length
    assert tongue.half_width == pytest.approx(np.ptp(points[:, 0]) / 2, rel=1e-6)
    assert not tongue.open_rim and tongue.attached[points[:, 2].argmin()]


def test_coordinates_rebuild_the_vertices(tiny):
    tongue = find_tongue(tiny)
    along = [np.interp(tongue.share, tongue.stations, values) for values in (*tongue.centre.T, *tongue.up.T)]
    lateral, height, ahead = tongue.local.T
    forward = np.stack([np.interp(tongue.share, tongue.stations, t) for t in tongue.tangent.T], 1)
    rebuilt = np.stack(along[:3], 1) + height[:, None] * np.stack(along[3:], 1) + ahead[:, None] * forward
    rebuilt[:, 0] += lateral
    assert np.abs(rebuilt - tongue.rest).max() < 1e-5  # frames are interpolated between stations
    assert (tongue.arc >= 0).all() and tongue.arc.max() == pytest.approx(tongue.length)


def test_share_is_symmetric_and_grows_towards_the_tip(tiny):
    tongue = find_tongue(tiny)
    assert np.array_equal(tongue.share, tongue.share[tongue.mirror])
    assert tongue.share[tongue.attached].max() == 0 and tongue.share[tongue.tip] == pytest.approx(1, abs=1e-9)
    middle = np.abs(tongue.rest[:, 0]) < 1e-6
    order = np.argsort(tongue.rest[middle & tongue.dorsum, 2])
    assert (np.diff(tongue.share[middle & tongue.dorsum][order]) > -1e-9).all()
    assert (tongue.height[tongue.dorsum].mean() > 0) and (tongue.height[~tongue.dorsum].mean() < 0)


def _with_tongue(tiny, move):
    members = regions.tongue(tiny)
    vertices = tiny.template_vertex_positions.copy()
    vertices[members] = move(vertices[members])
    return replace(tiny, template_vertex_positions=vertices)


def test_a_tongue_without_a_tip_is_refused_with_the_figure(tiny):
    members = regions.tongue(tiny)
    tongue = tiny.template_vertex_positions[members]
    middle = tongue.mean(0)
    half = np.flatnonzero(members)[tongue[:, 2] > middle[2]]
    gone = np.isin(tiny.triangles, half).any(1)
    kept = np.unique(tiny.triangles[~gone])
    groups = tiny.vertex_groups.copy()
    row = tiny.vertex_group_names.tolist().index("tongue")
    groups[row] *= np.isin(np.arange(groups.shape[1]), kept)
    cut = replace(tiny, triangles=tiny.triangles[~gone], triangle_uvs=tiny.triangle_uvs[~gone], vertex_groups=groups)
    with pytest.raises(InputError) as error:
        find_tongue(cut)
    assert "tip" in error.value.what and " mm behind the foremost point" in error.value.got

    def box(points):
        far = np.abs(points - middle) / np.ptp(tongue, axis=0)
        return middle + (points - middle) / far.max(1, keepdims=True).clip(1e-3)

    with pytest.raises(InputError) as error:
        find_tongue(_with_tongue(tiny, lambda points: box(points).astype(np.float32)))
    assert "% of the largest width" in error.value.got
    with pytest.raises(InputError) as error:
        find_tongue(_with_tongue(tiny, lambda points: (middle + 0.2 * (points - middle)).astype(np.float32)))
    assert error.value.got.endswith("mm")
    with pytest.raises(InputError, match="tip"):
        find_tongue(replace(tiny, vertex_groups=tiny.vertex_groups * (np.arange(len(groups)) != row)[:, None]))


@needs_shared
def test_an_open_tongue_is_attached_at_its_rim():
    data = gnm_npz.read(SHARED / "data" / "gnm" / "gnm_head_reconstructed.npz")
    tongue = find_tongue(data)
    assert tongue.open_rim
    assert np.array_equal(tongue.attached, boundary_vertices(tongue.triangles, len(tongue.rest)))
    assert tongue.rest[tongue.tip] == pytest.approx([0, 0.2298, 0.1172], abs=1e-3)
    # The free part's sections are narrower towards the tip; its centre line rises from the rim, then runs forwards.
    widths = [np.ptp(tongue.section(share)[..., 0]) for share in (0.4, 0.6, 0.8, 0.95)]
    assert widths == sorted(widths, reverse=True)
    assert tongue.axis[2] > 0.9 and tongue.tangent[10, 1] > 0.5
