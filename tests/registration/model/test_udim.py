from dataclasses import replace

import numpy as np
import pytest

from registration.errors import InputError
from registration.geometry.texels import texels
from registration.model import gnm_npz
from registration.model.gnm_npz import GNMData
from registration.model.regions import components
from registration.model.udim import TILES, tile_origin, udim_layout
from tests.conftest import SHARED, needs_shared
from tests.fixtures.make_fixtures import tiny_model


def moved(data: GNMData, name: str, shift: tuple[float, float]) -> GNMData:
    """The model with the uvs of one component elsewhere."""
    own = components(data) == data.mesh_component_names.tolist().index(name)
    triangle_uvs, quad_uvs = data.triangle_uvs.copy(), data.quad_uvs.copy()
    triangle_uvs[own[data.triangles[:, 0]]] += np.float32(shift)
    quad_uvs[own[data.quads[:, 0]]] += np.float32(shift)
    return replace(data, triangle_uvs=triangle_uvs, quad_uvs=quad_uvs)


def check(data: GNMData) -> None:
    layout = udim_layout(data)
    for tiles, uvs, given in (
        (layout.triangle_tiles, layout.triangle_uvs, data.triangle_uvs),
        (layout.quad_tiles, layout.quad_uvs, data.quad_uvs),
    ):
        assert set(tiles.tolist()) <= TILES.keys() and uvs.dtype == given.dtype
        origins = np.array([tile_origin(tile) for tile in tiles.tolist()])[:, None]
        local = uvs - origins
        assert local.min() > -1e-4 and local.max() < 1 + 1e-4
        shift = uvs.astype(np.float64) - given
        np.testing.assert_allclose(shift, np.round(shift), atol=1e-6)  # whole tiles only
        # As a renderer finds the tile from the coordinates.
        low = np.floor(uvs.min(1))
        np.testing.assert_array_equal(1001 + low[:, 0] + 10 * low[:, 1], tiles)
    parts = components(data)
    for tile in layout.tiles:
        shown = set(data.mesh_component_names[parts[data.triangles[layout.triangle_tiles == tile, 0]]].tolist())
        side, _, kind = TILES[tile].part.rpartition("_")
        assert {"eyes": {side}, "skin": {"skin"}, "tongue": {"tongue"}}.get(TILES[tile].material, shown) == shown
        assert kind != "teeth" or all("teeth" in name for name in shown)


def test_each_part_has_a_tile_of_its_own():
    data = tiny_model()
    check(data)
    assert udim_layout(data).tiles == (1001, 1002, 1003, 1004, 1005, 1006, 1007, 1008)


def test_triangles_and_quads_agree():
    data = tiny_model()
    layout = udim_layout(data)
    halves = layout.quad_uvs[:, [[0, 1, 2], [2, 3, 0]]].reshape(-1, 3, 2)
    np.testing.assert_array_equal(halves, layout.triangle_uvs)


def test_teeth_that_interleave_share_a_tile():
    """As in the official file: each jaw's map in its own half of the square."""
    data = tiny_model()
    uvs = [data.triangle_uvs.copy(), data.quad_uvs.copy()]
    for row, name in enumerate(("upper_teeth_and_gums", "lower_teeth_and_gums")):
        own = components(data) == data.mesh_component_names.tolist().index(name)
        for uv, faces in zip(uvs, (data.triangles, data.quads), strict=True):
            members = own[faces[:, 0]]
            uv[members, :, 1] = uv[members, :, 1] / 2 + row / 2
    data = replace(data, triangle_uvs=uvs[0], quad_uvs=uvs[1])
    check(data)
    assert udim_layout(data).tiles == (1001, 1002, 1003, 1004, 1005, 1006, 1007)


@pytest.mark.parametrize("shift", [(0, 0), (3, 0), (0, 2), (-1, -2)])
def test_a_part_in_another_tile_is_brought_to_its_own(shift):
    data = tiny_model()
    expected, layout = udim_layout(data), udim_layout(moved(data, "tongue", shift))
    np.testing.assert_allclose(layout.triangle_uvs, expected.triangle_uvs, atol=1e-6)
    np.testing.assert_array_equal(layout.quad_tiles, expected.quad_tiles)


def test_a_layout_of_a_layout_is_the_same():
    data = tiny_model()
    layout = udim_layout(data)
    again = udim_layout(replace(data, triangle_uvs=layout.triangle_uvs, quad_uvs=layout.quad_uvs))
    np.testing.assert_array_equal(again.triangle_tiles, layout.triangle_tiles)
    np.testing.assert_array_equal(again.quad_uvs, layout.quad_uvs)


def test_a_part_across_tiles_is_refused():
    with pytest.raises(InputError, match="texture coordinates of the tongue") as caught:
        udim_layout(moved(tiny_model(), "tongue", (0.5, 0)))
    assert "u, v from" in caught.value.got


def test_an_unknown_component_is_refused():
    data = tiny_model()
    names, groups = data.mesh_component_names.astype("<U20"), data.vertex_group_names.astype("<U32")
    names[names == "tongue"], groups[groups == "tongue"] = "hair", "hair"
    with pytest.raises(InputError, match="no UDIM tile") as caught:
        udim_layout(replace(data, mesh_component_names=names, vertex_group_names=groups))
    assert caught.value.got == "hair"


@needs_shared
def test_the_full_head():
    data = gnm_npz.read(SHARED / "data" / "gnm" / "gnm_head_reconstructed.npz")
    check(data)
    layout = udim_layout(data)
    sizes = dict(zip(*np.unique(layout.triangle_tiles, return_counts=True), strict=True))
    assert (sizes[1002], sizes[1003], sizes[1004], sizes[1005]) == (744, 768, 744, 768)
    for tile in layout.tiles:  # every triangle has texels of its own: nothing in a tile overlaps
        own = layout.triangle_tiles == tile
        uvs = (layout.triangle_uvs[own] - tile_origin(tile)).astype(np.float64)
        edges = uvs[:, 1:] - uvs[:, :1]
        area = np.abs(edges[:, 0, 0] * edges[:, 1, 1] - edges[:, 0, 1] * edges[:, 1, 0]).sum() / 2
        covered = len(texels(data.triangles[own], uvs, 1024).index) / 1024**2
        assert abs(area - covered) < 0.01 * area + 2e-3
