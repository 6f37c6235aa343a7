"""Raw scans made fit for rendering: duplicates merged, broken and stray parts left out, each with its number.

Nothing is filled in or moved: where a scan has a hole, nothing is known.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8
from scipy.spatial import cKDTree

from registration.capture.scan import distinct_triangles, require_finite
from registration.errors import InputError
from registration.geometry.topology import boundary_vertices, connected_parts
from registration.storage.mesh_files import MeshFile

# Of the largest part's area: small parts count beside large ones, as eyeballs do; dust never does.
_SMALL_PART, _DUST = 0.01, 1e-4
_BESIDE = 0.01  # of the scan's extent
_SPIKE = 12.0  # times the 90th percentile of the edges' lengths
_MIN_FACES = 300  # of a scan that shows a face
_SAMPLE = 100_000  # edges whose lengths are compared


@dataclass(frozen=True, kw_only=True)
class RawScan:
    """A cleaned scan; in the file's unit and axes until `scaled`."""

    vertices: Float[np.ndarray, "V 3"]
    triangles: Int[np.ndarray, "F 3"]
    colours: Float[np.ndarray, "V 3"] | None  # sRGB in [0, 1]
    corner_uvs: Float[np.ndarray, "F 3 2"] | None
    face_textures: Int[np.ndarray, "F"] | None
    textures: tuple[Path | UInt8[np.ndarray, "H W 3"], ...]

    def scaled(self, factor: float) -> "RawScan":
        """The same scan in another unit."""
        return replace(self, vertices=self.vertices * factor)

    def turned_over(self) -> "RawScan":
        """The same scan with its faces wound the other way."""
        uvs = None if self.corner_uvs is None else self.corner_uvs[:, ::-1]
        return replace(self, triangles=self.triangles[:, ::-1].copy(), corner_uvs=uvs)

    @property
    def coloured(self) -> bool:
        """Whether it has vertex colours or textures."""
        return self.colours is not None or bool(self.textures)

    def with_faces(self, kept: Bool[np.ndarray, "F"]) -> "RawScan":
        """The same scan with some of its faces, and only their vertices."""
        triangles = self.triangles[kept]
        used = np.zeros(len(self.vertices), bool)
        used[triangles] = True
        return replace(
            self,
            vertices=self.vertices[used],
            triangles=(np.cumsum(used) - 1)[triangles],
            colours=None if self.colours is None else self.colours[used],
            corner_uvs=None if self.corner_uvs is None else self.corner_uvs[kept],
            face_textures=None if self.face_textures is None else self.face_textures[kept],
        )


def clean(mesh: MeshFile, path: Path) -> tuple[RawScan, dict[str, Any]]:
    """Clean a scan.

    Args:
        mesh: as read.
        path: its file, for messages.

    Returns:
        The scan, and what was found and left out: the figures `scan_hygiene` of docs/formats.md, without lengths.

    Raises:
        InputError: it has no surface, or vertices of faces are not finite.
    """
    if not len(mesh.triangles):
        raise _unusable(
            path, "a surface of triangles", f"{len(mesh.vertices)} points without faces", "mesh the points first"
        )
    used = np.zeros(len(mesh.vertices), bool)
    used[mesh.triangles] = True
    require_finite(path, mesh.vertices, used)
    merged, index = _merged(mesh.vertices, used)
    scan = RawScan(
        vertices=merged,
        triangles=index[mesh.triangles],
        colours=None if mesh.colours is None else _first_of_each(mesh.colours[used], index[used], len(merged)),
        corner_uvs=mesh.corner_uvs,
        face_textures=mesh.face_textures,
        textures=mesh.textures,
    )
    kept = np.zeros(len(scan.triangles), bool)
    kept[distinct_triangles(scan.triangles)] = True
    figures: dict[str, Any] = {
        "vertices": len(mesh.vertices),
        "faces": len(mesh.triangles),
        "unused_vertices": int((~used).sum()),
        "merged_vertices": int(used.sum()) - len(merged),
        "degenerate_or_repeated_faces": int((~kept).sum()),
    }
    scan = scan.with_faces(kept)
    if len(scan.triangles) < _MIN_FACES:
        raise _unusable(path, f"at least {_MIN_FACES} faces", len(scan.triangles), "export the scan itself, not a hull")
    spikes = _spikes(scan)
    figures["spike_faces"] = int(spikes.sum())
    scan = scan.with_faces(~spikes)
    small, parts = _small_parts(scan)
    figures |= {"parts": parts, "small_parts_faces": int(small.sum())}
    scan = scan.with_faces(~small)
    figures |= _edges(scan)
    return scan, figures


def hygiene_notes(figures: Mapping[str, Any]) -> list[str]:
    """What was left out of a scan, or may harm it, as lines for the user."""
    words = {
        "merged_vertices": "vertices at the same place merged",
        "degenerate_or_repeated_faces": "degenerate or repeated faces left out",
        "spike_faces": "faces of spikes left out",
        "small_parts_faces": "faces of small separate parts left out",
        "non_manifold_edges": "edges with more than two faces",
        "holes": "borders: holes and cuts, where nothing is known",
    }
    return [f"scan: {figures[name]} {text}" for name, text in words.items() if figures.get(name)]


def _merged(
    vertices: Float[np.ndarray, "V 3"], used: Bool[np.ndarray, "V"]
) -> tuple[Float[np.ndarray, "M 3"], Int[np.ndarray, "V"]]:
    """Vertices at the same place as one, in order of their first; and of each the number of the one that replaces it.

    Programs split vertices at the seams of textures, and STL files at every face.
    """
    points = vertices[used]
    size = float(np.ptp(points, axis=0).max()) or 1.0
    keys = np.round((points - points.min(0)) / (size * 1e-7)).astype(np.int64)
    _, first, inverse = np.unique(keys, axis=0, return_index=True, return_inverse=True)
    order = np.argsort(first)
    rank = np.empty_like(order)
    rank[order] = np.arange(len(order))
    index = np.full(len(vertices), -1)
    index[used] = rank[inverse.ravel()]
    return points[first[order]], index


def _first_of_each(values: np.ndarray, index: Int[np.ndarray, "P"], count: int) -> np.ndarray:
    result = np.empty((count, *values.shape[1:]), values.dtype)
    result[index[::-1]] = values[::-1]
    return result


def _spikes(scan: RawScan) -> Bool[np.ndarray, "F"]:
    """Faces with an edge far longer than nearly all others."""
    corners = scan.vertices[scan.triangles]
    length = np.linalg.norm(corners - np.roll(corners, 1, 1), axis=-1).max(1)
    typical = float(np.quantile(length[:: -(-len(length) // _SAMPLE)], 0.9))
    return length > _SPIKE * typical


def _small_parts(scan: RawScan) -> tuple[Bool[np.ndarray, "F"], int]:
    """Faces of parts that are dust, or small and away from the large ones, and the number of the others."""
    part = connected_parts(scan.triangles)
    a, b, c = (scan.vertices[scan.triangles[:, k]] for k in range(3))
    area = np.bincount(part, np.linalg.norm(np.cross(b - a, c - a), axis=1))
    small = area < _SMALL_PART * area.max()
    if small.any():
        large = np.unique(scan.triangles[~small[part]])
        nearest = cKDTree(scan.vertices[large]).query(scan.vertices)[0][scan.triangles].min(1)
        distance = np.full(len(area), np.inf)
        np.minimum.at(distance, part, nearest)
        beside = distance < _BESIDE * float(np.ptp(scan.vertices, axis=0).max())
        small &= ~(beside & (area > _DUST * area.max()))
    return small[part], int((~small).sum())


def _edges(scan: RawScan) -> dict[str, int]:
    """Edges of more than two faces, and closed borders."""
    start, end = scan.triangles.ravel(), np.roll(scan.triangles, -1, 1).ravel()
    count = len(scan.vertices)
    keys, uses = np.unique(np.minimum(start, end) * count + np.maximum(start, end), return_counts=True)
    border = np.stack(np.divmod(keys[uses == 1], count), 1)
    loops = 0
    if len(border):
        loops = len(np.unique(connected_parts(np.column_stack([border, border[:, :1]]))))
    return {"non_manifold_edges": int((uses > 2).sum()), "holes": loops}


def border_tree(scan: RawScan) -> cKDTree | None:
    """The vertices on the scan's borders, for distances; None for a closed one."""
    border = boundary_vertices(scan.triangles, len(scan.vertices))
    return cKDTree(scan.vertices[border]) if border.any() else None


def _unusable(path: Path, expected: object, got: object, fix: str) -> InputError:
    return InputError("The scan cannot be registered", where=path, expected=expected, got=got, fix=fix)
