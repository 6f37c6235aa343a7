"""Topology of a raw scan, by PyMeshLab. Only this file imports it: it is GPL and an extra (`mesh`)."""

from dataclasses import dataclass

import lagrange  # noqa: F401  before PyMeshLab: with PyMeshLab's older TBB loaded first, Lagrange cannot start
import numpy as np
from jaxtyping import Float, Int

from registration.geometry.quads import edges_of


@dataclass(frozen=True, kw_only=True)
class ScanTopology:
    """Connectivity of a scan's surface and its defects."""

    components: int
    holes: int  # closed loops of boundary edges; -1: undefined because of non-manifold edges
    boundary_edges: int
    non_manifold_edges: int
    non_manifold_vertices: int

    def __str__(self) -> str:
        holes = "holes unknown" if self.holes < 0 else f"{self.holes} holes"
        return (
            f"{self.components} components, {holes}, {self.boundary_edges} boundary edges, "
            f"{self.non_manifold_edges} non-manifold edges, {self.non_manifold_vertices} non-manifold vertices"
        )


def scan_topology(vertices: Float[np.ndarray, "V 3"], triangles: Int[np.ndarray, "F 3"]) -> ScanTopology | None:
    """Measure the topology of a scan; None where PyMeshLab is not installed or cannot be loaded."""
    try:
        import pymeshlab
    except ImportError:
        return None
    meshes = pymeshlab.MeshSet(verbose=False)
    meshes.add_mesh(pymeshlab.Mesh(vertices.astype(np.float64), triangles.astype(np.int32)))
    measures = meshes.get_topological_measures()
    return ScanTopology(
        components=measures["connected_components_number"],
        holes=measures["number_holes"],
        boundary_edges=measures["boundary_edges"],
        # MeshLab's own count reads uninitialized memory.
        non_manifold_edges=int((edges_of(triangles)[2] > 2).sum()),
        non_manifold_vertices=measures["non_two_manifold_vertices"],
    )
