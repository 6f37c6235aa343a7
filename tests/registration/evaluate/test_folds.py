"""Folds of a head are counted where they are, and remarks name the place."""

import numpy as np
import pytest

from registration.evaluate.folds import fold_figures
from registration.geometry.folds import Creases
from registration.model import regions
from registration.report.remarks import remarks
from tests.fixtures.make_fixtures import tiny_model
from tests.registration.evaluate.cameras import looking_at
from tests.registration.report.test_page import a_registration

DATA = tiny_model()
REST = DATA.template_vertex_positions.astype(np.float64)


def folded(members: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The head with one vertex pushed across a neighbour, so that edges of the members are sharp; and all that are."""
    creases = Creases.of(DATA.triangles, REST, regions.exterior(DATA))
    for vertex in np.flatnonzero(regions.exterior(DATA)):
        for edge in creases.vertices[(creases.vertices == vertex).any(1)]:
            other = edge[edge != vertex][0]
            mesh = REST.copy()
            mesh[vertex] += 2.5 * (REST[other] - REST[vertex])
            sharp = creases.sharp(mesh, 120)
            if len(sharp) and members[sharp].any():
                return mesh, sharp
    raise AssertionError("nothing folds")


def test_the_template_has_none():
    assert fold_figures(REST, DATA, {}) == {"edges": 0, "places": {}}
    assert fold_figures(1.1 * REST + 3.0, DATA, {})["edges"] == 0


@pytest.mark.parametrize(("side", "sign"), [("left", 1.0), ("right", -1.0)])
def test_a_fold_of_a_lid_is_found_there_in_the_view_that_looks_at_it(side, sign):
    cameras = {
        name: looking_at(REST.mean(0), np.array([x, 0.0, 1.0]), 1.0, 400)
        for name, x in (("from left", 1.0), ("from right", -1.0))
    }
    lids = regions.offset_regions(DATA)["lids"] & (sign * REST[:, 0] > 0)
    mesh, sharp = folded(lids)
    figures = fold_figures(mesh, DATA, cameras)
    assert figures["edges"] == len(sharp) == sum(place["edges"] for place in figures["places"].values())
    assert figures["places"][f"{side} eye"]["view"] == f"from {side}"
    lines = remarks(a_registration(figures={"folds": figures}))
    assert any(f"of the {side} eye (look at from {side})" in line for line in lines)


def test_a_remark_counts():
    places = {"nose": {"edges": 1, "view": "cam2"}, "mouth": {"edges": 3, "view": None}}
    [line] = remarks(a_registration(figures={"folds": {"edges": 4, "places": places}}))
    assert line.endswith("at 4 edges: 1 of the nose (look at cam2), 3 of the mouth.")
    assert remarks(a_registration(figures={"folds": {"edges": 0, "places": {}}})) == []
