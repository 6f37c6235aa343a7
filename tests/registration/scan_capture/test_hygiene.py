"""What scans bring along and what must be left: on a ball, where every number is known."""

from pathlib import Path

import numpy as np
import pytest
import trimesh

from registration.errors import InputError
from registration.scan_capture.hygiene import clean, hygiene_notes
from registration.storage.mesh_files import MeshFile

BALL = trimesh.creation.icosphere(subdivisions=4, radius=0.1)
POINTS, FACES = np.asarray(BALL.vertices, np.float64), np.asarray(BALL.faces)
FILE = Path("scan.ply")


def test_a_clean_scan_stays_as_it_is() -> None:
    scan, figures = clean(MeshFile(vertices=POINTS, triangles=FACES), FILE)
    np.testing.assert_array_equal(scan.vertices, POINTS)
    np.testing.assert_array_equal(scan.triangles, FACES)
    assert figures["parts"] == 1 and figures["holes"] == 0 and not hygiene_notes(figures)


def test_vertices_of_separate_triangles_are_merged_with_their_colours() -> None:
    colours = np.random.default_rng(0).random((len(POINTS), 3))
    soup = MeshFile(
        vertices=POINTS[FACES].reshape(-1, 3),
        triangles=np.arange(3 * len(FACES)).reshape(-1, 3),
        colours=colours[FACES].reshape(-1, 3),
    )
    scan, figures = clean(soup, FILE)
    assert len(scan.vertices) == len(POINTS) and figures["merged_vertices"] == 3 * len(FACES) - len(POINTS)
    np.testing.assert_array_equal(scan.vertices[scan.triangles], POINTS[FACES])
    assert scan.colours is not None
    np.testing.assert_array_equal(scan.colours[scan.triangles], colours[FACES])


def test_dust_spikes_and_far_parts_are_left_out_and_parts_beside_the_large_one_stay() -> None:
    far = 0.05 * POINTS + [1, 0, 0]
    beside = 0.08 * POINTS + [0.1085, 0, 0]
    vertices = np.concatenate([POINTS, far, beside, [[0.0, 0.0, 3.0]]])
    spike = [[0, int(FACES[0, 1]), len(vertices) - 1]]
    count = len(POINTS)
    scan, figures = clean(
        MeshFile(vertices=vertices, triangles=np.concatenate([FACES, FACES + count, FACES + 2 * count, spike])), FILE
    )
    assert figures["spike_faces"] == 1 and figures["small_parts_faces"] == len(FACES) and figures["parts"] == 2
    assert len(scan.triangles) == 2 * len(FACES)
    assert scan.vertices[:, 0].max() < 0.12


def test_holes_and_edges_of_three_faces_are_counted() -> None:
    centres = POINTS[FACES].mean(1)
    cut = FACES[(centres[:, 2] < 0.09) & (centres[:, 0] > -0.09)]
    start, end = cut[0, :2]
    fin = np.array([[start, end, len(POINTS)]])
    vertices = np.concatenate([POINTS, 1.05 * POINTS[[start]]])
    _, figures = clean(MeshFile(vertices=vertices, triangles=np.concatenate([cut, fin])), FILE)
    assert figures["non_manifold_edges"] == 1 and figures["holes"] >= 2


@pytest.mark.parametrize(
    ("mesh", "got"),
    [
        (MeshFile(vertices=POINTS, triangles=np.zeros((0, 3), np.int64)), "points without faces"),
        (MeshFile(vertices=POINTS, triangles=FACES[:20]), "20"),
        (
            MeshFile(vertices=np.where(np.arange(len(POINTS))[:, None] == 5, np.nan, POINTS), triangles=FACES),
            "vertex 5",
        ),
    ],
)
def test_what_is_no_surface_is_refused(mesh: MeshFile, got: str) -> None:
    with pytest.raises(InputError) as error:
        clean(mesh, FILE)
    assert got in error.value.got
