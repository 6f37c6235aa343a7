from dataclasses import replace

import numpy as np
import pytest

from registration.detect import face478_points as named
from registration.detect.map_checks import check_map, draw_map
from registration.geometry.closest_point import closest_points
from registration.model import gnm_npz
from registration.model.landmarks import LandmarkScheme, shipped_schemes
from tests.conftest import SHARED, needs_shared
from tests.fixtures.make_fixtures import tiny_model


@needs_shared
def test_the_shipped_map_passes_and_spoiled_ones_fail():
    data = gnm_npz.read(SHARED / "data" / "gnm" / "gnm_head_reconstructed.npz")
    scheme = shipped_schemes(data)["face478"]
    assert scheme.spread_m is not None and len(scheme.indices) == named.COUNT
    template = data.template_vertex_positions.astype(np.float64)
    mirrored = np.linalg.norm(scheme.points(template)[:, None] * (-1, 1, 1) - scheme.points(template)[None], axis=2)
    opposite = tuple(mirrored.argmin(1).tolist())
    assert all(check.passed for check in check_map(data, scheme, opposite, {}))

    def failed(rows: dict[int, int]) -> set[str]:
        indices, weights = scheme.indices.copy(), scheme.weights.copy()
        for target, source in rows.items():
            indices[target], weights[target] = scheme.indices[source], scheme.weights[source]
        spoiled = replace(scheme, indices=indices, weights=weights)
        return {check.name for check in check_map(data, spoiled, opposite, {}) if not check.passed}

    assert "order of the lips, mouth closed" in failed({13: 17, 17: 13})
    assert "irises" in failed({named.LEFT_PUPIL: named.RIGHT_PUPIL})
    assert "lid aperture, open" in failed({158: 105, 159: 105, 160: 105})
    assert "left against right" in failed({61: 0})
    lids = scheme.spread_m[list(named.REGIONS["lids"])]
    assert np.median(lids) < 4e-3 < np.median(scheme.spread_m[list(named.FACE_OVAL)]) + 2e-3


@pytest.mark.slow
def test_the_picture_shows_every_model(tmp_path):
    data = tiny_model()
    points = np.random.default_rng(0).normal(0, 0.05, (20, 3)) + data.template_vertex_positions.mean(0)
    _, face, weights = closest_points(points, data.template_vertex_positions, data.triangles)
    scheme = LandmarkScheme(
        name="x", indices=data.triangles[face].astype(np.int64), weights=weights, spread_m=np.full(20, 2e-3)
    )
    draw_map(data, scheme, tmp_path / "map.png")
    assert (tmp_path / "map.png").stat().st_size > 10_000
