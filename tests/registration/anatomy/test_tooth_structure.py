from dataclasses import replace

import numpy as np
import pytest

from registration.anatomy.tooth_structure import COUNTS, find_teeth, tooth_labels
from registration.errors import InputError
from registration.model import gnm_npz
from tests.conftest import SHARED

FDI_UPPER = (17, 16, 15, 14, 13, 12, 11, 21, 22, 23, 24, 25, 26, 27)
FDI_LOWER = (47, 46, 45, 44, 43, 42, 41, 31, 32, 33, 34, 35, 36, 37)
RECONSTRUCTED = SHARED / "data" / "gnm" / "gnm_head_reconstructed.npz"


@pytest.fixture(scope="session")
def first():
    from coregister.first_model import build
    from registration.errors import InputError as Missing

    try:
        return gnm_npz.read(build.bootstrap())
    except Missing as error:
        pytest.skip(error.what)


def _without(data, group, vertices):
    groups = data.vertex_groups.copy()
    groups[data.vertex_group_names.tolist().index(group), vertices] = 0
    return replace(data, vertex_groups=groups)


def test_first_model_has_the_teeth_that_its_builder_placed(first):
    upper, lower = find_teeth(first)
    assert tuple(tooth.fdi for tooth in upper.teeth) == FDI_UPPER
    assert tuple(tooth.fdi for tooth in lower.teeth) == FDI_LOWER
    by_fdi = {tooth.fdi: tooth for arch in (upper, lower) for tooth in arch.teeth}
    for fdi, tooth in by_fdi.items():
        mirrored = by_fdi[fdi + (10 if fdi // 10 in (1, 3) else -10)]
        assert np.array_equal(np.sort(first.mirror_indices[tooth.vertices]), mirrored.vertices)
        assert np.allclose(tooth.origin * [-1, 1, 1], mirrored.origin, atol=3e-4)  # its triangles are not mirrored
        assert np.allclose(tooth.axes @ tooth.axes.T, np.eye(3), atol=1e-9)
        down = fdi < 30
        assert tooth.axes[2, 1] * (-1 if down else 1) > 0.85, "towards the other arch"
        assert 4e-3 < tooth.size[0] < 12e-3 and 5e-3 < tooth.size[2] < 10e-3
    assert by_fdi[11].axes[1, 2] > 0.85 and by_fdi[27].axes[1, 0] > 0.85, "outwards"
    assert by_fdi[21].axes[0, 0] > 0.85 and by_fdi[11].axes[0, 0] < -0.85, "away from the midline"
    labels = tooth_labels((upper, lower))
    assert len(labels) == 28 and labels[16][0] < 0 < labels[26][0]


def test_neck_line_is_where_the_tooth_leaves_the_gum(first):
    from registration.geometry.closest_point import closest_points

    vertices = first.template_vertex_positions.astype(np.float64)
    for arch in find_teeth(first):
        line = np.concatenate([tooth.neck_line(vertices) for tooth in arch.teeth])
        distance = closest_points(line, vertices, arch.gum_triangles)[0]
        assert np.quantile(distance, 0.95) < 1e-4
        assert len(np.unique(np.concatenate([t.vertices for t in arch.teeth]))) == sum(
            len(t.vertices) for t in arch.teeth
        )


@pytest.mark.skipif(not RECONSTRUCTED.is_file(), reason="no reconstructed file")
def test_crowns_of_one_surface_with_the_gum():
    data = gnm_npz.read(RECONSTRUCTED)
    for arch in find_teeth(data):
        assert len(arch.teeth) in COUNTS
        assert [tooth.fdi % 10 for tooth in arch.teeth] == [*range(8, 0, -1), *range(1, 9)]
        for tooth in arch.teeth:
            assert tooth.crown.all() and (tooth.neck[:, 0] == tooth.neck[:, 1]).all()
            assert np.isin(tooth.neck[:, 0], arch.gum_triangles).all()


def test_a_missing_piece_is_refused(first):
    gone = find_teeth(first)[0].teeth[4].vertices
    with pytest.raises(InputError, match="one piece per tooth") as error:
        find_teeth(_without(first, "teeth", gone))
    assert "13 pieces" in error.value.got and "mm wide" in error.value.got


def test_a_part_of_a_tooth_outside_the_groups_is_refused(first):
    edge = find_teeth(first)[0].teeth[4]
    gone = edge.vertices[np.argsort(first.template_vertex_positions[edge.vertices, 1])[:3]]
    with pytest.raises(InputError, match="neither teeth nor gums") as error:
        find_teeth(_without(first, "teeth", gone))
    assert "3 in neither" in error.value.got


def test_teeth_of_one_side_alone_are_refused(first):
    arch = find_teeth(first)[1]
    gone = np.concatenate([tooth.vertices for tooth in arch.teeth[:2]])
    data = _without(first, "teeth", gone)
    with pytest.raises(InputError, match="one piece per tooth"):
        find_teeth(data)


def test_a_tooth_above_the_gum_is_refused(first):
    tooth = find_teeth(first)[0].teeth[0]
    vertices = first.template_vertex_positions.copy()
    vertices[tooth.vertices, 1] -= 0.02
    with pytest.raises(InputError, match="does not stand in the gum"):
        find_teeth(replace(first, template_vertex_positions=vertices))
