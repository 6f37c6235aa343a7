from dataclasses import replace

import numpy as np
import pytest

from registration.model import gnm_npz
from registration.model.atlas import texture_atlas
from registration.model.regions import components
from tests.conftest import SHARED, needs_shared
from tests.fixtures.make_fixtures import tiny_model


def signed_areas(uvs: np.ndarray) -> np.ndarray:
    a, b = uvs[:, 1] - uvs[:, 0], uvs[:, 2] - uvs[:, 0]
    return (a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]) / 2


def footprint(uvs: np.ndarray, resolution: int) -> np.ndarray:
    """At least the texels that bilinear lookups on these triangles touch: those of the triangles' bounding boxes."""
    touched = np.zeros((resolution, resolution), bool)
    low = np.floor(uvs.min(1).astype(np.float64) * resolution - 0.5).astype(int)
    high = np.floor(uvs.max(1).astype(np.float64) * resolution - 0.5).astype(int) + 1
    for (x0, y0), (x1, y1) in zip(low.clip(0), high, strict=True):
        touched[y0 : y1 + 1, x0 : x1 + 1] = True
    return touched


@pytest.fixture(params=["tiny", pytest.param("full", marks=needs_shared)], scope="module")
def data(request) -> gnm_npz.GNMData:
    if request.param == "tiny":
        return tiny_model()
    return gnm_npz.read(SHARED / "data" / "gnm" / "gnm_head_reconstructed.npz")


@pytest.mark.parametrize("resolution", [256, 512, 1024])
def test_bilinear_lookups_do_not_mix_charts(data, resolution):
    uvs, part = texture_atlas(data), components(data)[data.triangles[:, 0]]
    assert uvs.shape == (len(data.triangles), 3, 2) and uvs.min() > 0 and uvs.max() < 1
    owners = np.zeros((resolution, resolution), int)
    for k in range(len(data.mesh_component_names)):
        owners += footprint(uvs[part == k], resolution)
    assert owners.max() == 1 and (owners > 0).mean() > 0.9


def test_no_triangle_is_flipped_or_missing(data):
    before, after = signed_areas(data.triangle_uvs.astype(float)), signed_areas(texture_atlas(data).astype(float))
    assert (np.sign(after) == np.sign(before)).all() and (np.abs(after) > 0).all()
    part = components(data)[data.triangles[:, 0]]
    area = np.array([np.abs(after[part == k]).sum() for k in range(part.max() + 1)])
    assert area[0] > 0.75 and (area[1:] > 0.01).all() and area.sum() < 1


def test_maps_on_tiles_of_their_own_give_the_same_atlas(data):
    """Some files keep components apart by whole-number shifts instead of by the component alone."""
    part = components(data)[data.triangles[:, 0]]
    shifted = replace(data, triangle_uvs=data.triangle_uvs + part[:, None, None].astype(np.float32) * (1, 0))
    np.testing.assert_allclose(texture_atlas(shifted), texture_atlas(data), atol=1e-5)


def test_one_component_fills_the_atlas():
    data = tiny_model()
    skin = components(data)[data.triangles[:, 0]] == 0
    only = replace(data, triangles=data.triangles[skin], triangle_uvs=data.triangle_uvs[skin])
    assert texture_atlas(only).max() > 0.99
