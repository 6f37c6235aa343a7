"""Texels of an atlas: where their centres lie, which chart they are of, and the points of the surface they name."""

import numpy as np
import pytest
import torch

from registration.geometry.texels import SurfacePoints, charts, eroded, single_chart, texels
from registration.model import gnm_npz
from registration.model.atlas import texture_atlas
from tests.conftest import FIXTURES

TINY = gnm_npz.read(FIXTURES / "tiny_gnm.npz")
SQUARE = np.array([[0, 1, 2], [0, 2, 3]])
SQUARE_UVS = np.array([[[0, 0], [1, 0], [1, 1]], [[0, 0], [1, 1], [0, 1]]], np.float32)


def test_a_square_by_hand():
    """The lower right triangle is face 0; texture rows run down from v = 1."""
    found = texels(SQUARE, SQUARE_UVS * [1, 0.5], 4)
    assert found.index.tolist() == list(range(8, 16))  # the lower half
    faces = found.image(found.face, -1)
    assert (faces[:2] == -1).all() and faces[2, 0] == 1 and faces[3, 3] == 0
    at = found.index.tolist().index(3 * 4 + 1)  # row 3, column 1: u = 0.375, v = 0.125 in a square half as high
    np.testing.assert_allclose(found.barycentric[at] @ SQUARE_UVS[found.face[at]], [0.375, 0.25], atol=1e-12)


def test_texels_name_the_points_whose_uvs_are_their_centres():
    uvs = texture_atlas(TINY)
    found = texels(TINY.triangles, uvs, 64)
    assert (np.diff(found.index) > 0).all() and len(found.index) > 64 * 64 / 2
    assert (found.barycentric >= -1e-9).all()
    at = np.einsum("kc,kcx->kx", found.barycentric, uvs[found.face].astype(np.float64))
    row, column = np.divmod(found.index, 64)
    np.testing.assert_allclose(at, np.stack([column + 0.5, 63.5 - row], 1) / 64, atol=1e-6)


def test_vertex_values_at_texels():
    found = texels(SQUARE, SQUARE_UVS, 8)
    height = found.interpolate(np.array([0.0, 0.0, 1.0, 1.0]), SQUARE)
    np.testing.assert_allclose(found.image(height, np.nan)[:, 0], (7.5 - np.arange(8)) / 8)
    assert found.interpolate(np.zeros((4, 3)), SQUARE).shape == (64, 3)


def test_charts_end_where_uvs_differ():
    assert len(set(charts(SQUARE, SQUARE_UVS))) == 1
    moved = SQUARE_UVS.copy()
    moved[1] += 1e-6
    assert len(set(charts(SQUARE, moved))) == 2
    moved[1, 0] = moved[0, 0]  # a shared corner is enough
    assert len(set(charts(SQUARE, moved))) == 1
    # Two sheets that lie on one another in the atlas share no vertex, so they are two charts.
    assert len(set(charts(np.concatenate([SQUARE, SQUARE + 4]), np.concatenate([SQUARE_UVS] * 2)))) == 2


def test_charts_of_a_head():
    """Its skin is one; eyeballs, teeth and tongue have the six sides of a cube each."""
    found = charts(TINY.triangles, texture_atlas(TINY))
    assert len(set(found)) == 1 + 5 * 6
    skin = TINY.vertex_groups[TINY.vertex_group_names.tolist().index("skin")] > 0
    assert len(set(found[skin[TINY.triangles].all(1)])) == 1


@pytest.mark.parametrize("reach", [1, 2, 4])
def test_neighbourhoods_against_a_search(reach):
    labels = np.full((30, 34), -1)
    labels[3:14, 2:20], labels[17:29, 5:34], labels[3:14, 23:33] = 4, 0, 7
    labels[8, 8] = -1  # a hole
    whole, alone = eroded(labels, reach), single_chart(labels, reach)
    for row, column in np.ndindex(labels.shape):
        own = labels[row, column]
        near = labels[max(0, row - reach) : row + reach + 1, max(0, column - reach) : column + reach + 1]
        inside = near.size == (2 * reach + 1) ** 2
        assert whole[row, column] == (own >= 0 and inside and (near == own).all())
        assert alone[row, column] == (own >= 0 and np.isin(near, (own, -1)).all())


def points(dtype: torch.dtype) -> tuple[SurfacePoints, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(0)
    corners = TINY.triangles[rng.integers(0, len(TINY.triangles), 5000)]
    barycentric = rng.dirichlet([1, 1, 1], 5000)
    like = torch.zeros((), dtype=dtype)
    return SurfacePoints(corners, barycentric, len(TINY.template_vertex_positions), like), corners, barycentric


def test_surface_points_and_their_gradients():
    surface, corners, barycentric = points(torch.float64)
    vertices = torch.tensor(TINY.template_vertex_positions, dtype=torch.float64, requires_grad=True)
    found = surface(vertices)
    expected = np.einsum("kc,kcx->kx", barycentric, TINY.template_vertex_positions[corners].astype(np.float64))
    np.testing.assert_allclose(found.detach(), expected, atol=1e-12)
    pull = torch.as_tensor(np.random.default_rng(1).standard_normal(found.shape))
    (gradient,) = torch.autograd.grad(found, vertices, pull)
    by_hand = np.zeros(vertices.shape)
    np.add.at(by_hand, corners, barycentric[..., None] * pull.numpy()[:, None])
    np.testing.assert_allclose(gradient, by_hand, atol=1e-12)


def test_surface_points_are_equal_from_run_to_run():
    surface, *_ = points(torch.float32)
    vertices = torch.tensor(TINY.template_vertex_positions, requires_grad=True)
    pull = torch.randn(5000, 3, generator=torch.Generator().manual_seed(0))
    first = torch.autograd.grad(surface(vertices), vertices, pull)[0]
    assert all(torch.equal(first, torch.autograd.grad(surface(vertices), vertices, pull)[0]) for _ in range(5))
