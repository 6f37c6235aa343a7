"""A capture in a georeferenced world is registered as one near its origin, and written in its own world."""

from pathlib import Path

import numpy as np
import pytest
import trimesh

from registration.options import RegisterOptions
from registration.storage.registration_folder import load_registration
from tests.fixtures.far_world import UTM, moved
from tests.registration.register.conftest import run
from tests.registration.register.synthetic import Truth, make

OPTIONS = RegisterOptions(recipe="preview", views=3, deterministic=True)


@pytest.mark.slow
def test_far_neutral_and_expression_are_registered_as_near_ones(neutral: Truth, tmp_path: Path) -> None:
    results = {}
    for name, truth in (("neutral", neutral), ("smile", make(tmp_path / "smile", "smile"))):
        for world in ("near", "far"):
            root = truth.root if world == "near" else moved(truth.root, tmp_path / f"far_{name}")
            start = None if name == "neutral" else tmp_path / f"{world}_neutral_out"
            here = Truth(
                root=root,
                parameters=truth.parameters,
                offsets=truth.offsets,
                vertices=truth.vertices,
                gains=truth.gains,
            )
            run(here, tmp_path / f"{world}_{name}_out", OPTIONS, neutral=start)
            results[name, world] = load_registration(tmp_path / f"{world}_{name}_out")
    for name in ("neutral", "smile"):
        near, far = results[name, "near"], results[name, "far"]
        seen = near.confidence > 0.5
        distance_mm = 1e3 * np.linalg.norm(far.vertices - UTM - near.vertices, axis=1)
        print(f"{name}: {distance_mm[seen].mean():.4f} mm on observed vertices")
        assert distance_mm[seen].mean() < 0.04
        assert far.vertices.dtype == far.translation.dtype == np.float64 and far.status == near.status
        for figure in ("scan_to_mesh", "vertex_error"):
            errors = [result.figures[figure]["face"]["mean_mm"] for result in (near, far)]
            assert errors[0] == pytest.approx(errors[1], abs=0.02), figure
        mesh = trimesh.load(tmp_path / f"far_{name}_out" / "mesh.ply", process=False, maintain_order=True)
        np.testing.assert_array_equal(mesh.vertices, far.vertices)
