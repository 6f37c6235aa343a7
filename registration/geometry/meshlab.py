"""What PyMeshLab tells about a raw scan. The only file that imports it: it is GPL and an extra (`mesh`)."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int


@dataclass(frozen=True, kw_only=True)
class ScanTopology:
    """How a scan's surface hangs together."""

    components: int
    holes: int  # closed rings of boundary edges; -1 where non-manifold edges leave that undefined
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
    """Components, holes and defects of a scan, or None where PyMeshLab is not installed or cannot start."""
    try:
        import pymeshlab
    except ImportError:
        return None
    meshes = pymeshlab.MeshSet(verbose=False)
    meshes.add_mesh(pymeshlab.Mesh(vertices.astype(np.float64), triangles.astype(np.int32)))
    found = meshes.get_topological_measures()
    return ScanTopology(
        components=found["connected_components_number"],
        holes=found["number_holes"],
        boundary_edges=found["boundary_edges"],
        non_manifold_edges=_crowded_edges(triangles),  # MeshLab's own count is of memory that nothing was written to
        non_manifold_vertices=found["non_two_manifold_vertices"],
    )


def _crowded_edges(triangles: Int[np.ndarray, "F 3"]) -> int:
    """How many edges have more than two triangles."""
    ends = np.sort(np.stack([triangles, np.roll(triangles, -1, axis=1)], -1).reshape(-1, 2).astype(np.int64), axis=1)
    _, count = np.unique(ends[:, 0] * (ends.max(initial=0) + 1) + ends[:, 1], return_counts=True)
    return int((count > 2).sum())
