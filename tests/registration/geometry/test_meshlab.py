"""The topology of a scan."""

import numpy as np
import pytest

from registration.geometry.meshlab import scan_topology

pytest.importorskip("pymeshlab", reason="no PyMeshLab, or no OpenGL libraries: make setup-optional")
TETRAHEDRON = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]])
CORNERS = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])


def test_holes_components_and_fins_are_counted() -> None:
    closed = scan_topology(CORNERS, TETRAHEDRON)
    assert closed is not None
    assert (closed.components, closed.holes, closed.boundary_edges, closed.non_manifold_edges) == (1, 0, 0, 0)

    two = scan_topology(np.concatenate([CORNERS, CORNERS + 5]), np.concatenate([TETRAHEDRON[1:], TETRAHEDRON + 4]))
    assert two is not None
    assert (two.components, two.holes, two.boundary_edges) == (2, 1, 3)

    fin = scan_topology(np.concatenate([CORNERS, [[3.0, 3, 3]]]), np.concatenate([TETRAHEDRON, [[0, 1, 4]]]))
    assert fin is not None
    assert fin.non_manifold_edges == 1 and fin.holes == -1
