"""Skin that is turned inside out is measured where it is, remarks name the place, and the verdict is no longer good."""

import numpy as np
import pytest

from registration.evaluate.reversed_skin import reversed_figures
from registration.evaluate.verdict import judge
from registration.model import regions
from registration.model.gnm_npz import GNMData
from registration.report.remarks import remarks
from registration.types import Camera
from tests.registration.evaluate.cameras import looking_at
from tests.registration.report.test_page import a_registration

GOOD = {"scan_to_mesh": {"face": {"mean_mm": 0.1, "median_mm": 0.05, "p95_mm": 0.3}}}


def around(mesh: np.ndarray, size_px: int = 500) -> dict[str, Camera]:
    """Cameras that look at the head from five sides."""
    angles = {degrees: np.radians(degrees) for degrees in (-90, -45, 0, 45, 90)}
    return {
        f"at {degrees}": looking_at(mesh.mean(0), np.array([np.sin(a), 0.0, np.cos(a)]), 0.8, size_px)
        for degrees, a in angles.items()
    }


@pytest.fixture(scope="module")
def rest(first_model: GNMData) -> np.ndarray:
    return first_model.template_vertex_positions.astype(np.float64)


def test_the_template_shows_its_outer_side(first_model, rest):
    assert reversed_figures(rest, first_model, around(rest)) == {"area_mm2": 0.0, "places": {}}
    assert reversed_figures(rest, first_model, {}) == {"area_mm2": None, "places": {}}


@pytest.mark.parametrize("size_px", [200, 2000])
def test_a_lid_that_is_turned_over_is_found_there(first_model, rest, size_px):
    lid = regions.offset_regions(first_model)["lids"] & (rest[:, 0] > 0)
    rolled = rest.copy()
    rolled[lid, 0] = 2 * rest[lid, 0].mean() - rest[lid, 0]  # mirrored, so that its faces turn over
    figures = reversed_figures(rolled, first_model, around(rest, size_px))
    assert set(figures["places"]) == {"left eye"} and 50 < figures["area_mm2"] < 2000
    assert figures["places"]["left eye"]["area_mm2"] == figures["area_mm2"]
    assert figures["places"]["left eye"]["view"] in ("at 0", "at 45", "at 90")
    figures = {**GOOD, "reversed_skin": figures}
    lines = remarks(a_registration(figures=figures))
    assert any("skin of the left eye is turned inside out" in line and "look at at" in line for line in lines)
    assert judge("converged", GOOD).level == "good"
    verdict = judge("converged", figures)
    assert verdict.level == "look" and "turned inside out (left eye)" in verdict.reasons[0]
