"""The topology of a scan."""

import subprocess
import sys

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


def test_closest_points_work_after_pymeshlab_was_loaded() -> None:
    """In a process of its own: PyMeshLab and Lagrange each bring a TBB, and only one order of loading works."""
    code = """
import numpy as np
from registration.geometry.meshlab import scan_topology
corners, faces = np.eye(4)[:, :3], np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]])
scan_topology(corners, faces)
from registration.geometry.closest_point import closest_points
print(closest_points(np.full((1, 3), 2.0), corners, faces)[0])
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
