"""Colours for the texels that no camera saw: from other registrations of the subject, the other side, the surroundings.

Seen are texels all of whose face's vertices have a confidence above 0. What is borrowed is shifted by a smooth field so
that it meets the seen texels around it without an edge; the field is harmonic on the mesh, so seams of the atlas do not
interrupt it.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import scipy.sparse as sp
from jaxtyping import Bool, Float, Int, UInt8
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import splu

from registration.export.head_mesh import Topology
from registration.geometry.quads import edges_of
from registration.geometry.texels import Texels, texels
from registration.types import Registration

FILLED = 255  # in the mask
_COMMON = 100  # vertices of a connected part that both must show before one's colours are shifted to the other's
_MOST_SHIFT = 0.1  # of linear light


@dataclass(frozen=True, kw_only=True, eq=False)
class FilledTexture:
    """A texture without unseen texels, and where they were."""

    texture: Float[np.ndarray, "R R 3"]  # linear
    unseen: UInt8[np.ndarray, "R R"]  # FILLED where no camera saw the texel, else 0; also between the charts
    shares: dict[str, float]  # of the unseen texels in charts, by where their colours come from


def fill_unseen(
    registration: Registration, topology: Topology, mirror: Int[np.ndarray, "V"], others: Sequence[Registration] = ()
) -> FilledTexture:
    """Fill the texels that no camera saw.

    In this order: the same texels of other registrations of the subject; the other side of the head; a smooth extension
    of what surrounds them; the mean of their material. A material of which nothing was seen keeps its colours.

    Args:
        registration: whose texture is filled.
        topology: of its model, with its uvs.
        mirror: the vertex on the other side, of each vertex.
        others: of the same topology and atlas, the preferred first.
    """
    size = len(registration.texture)
    known = texels(registration.triangles, registration.corner_uvs, size)
    graph = _Graph(topology)
    own = _Colours.of(registration.texture, registration.confidence > 0, known, registration.triangles)
    sources = [
        _Colours.of(_resized(other.texture, size), other.confidence > 0, known, registration.triangles)
        for other in others
    ]
    vertex, texel, origin = own.vertices.copy(), own.texels.copy(), np.where(own.seen_texels, 0, -1)
    seen = own.seen.copy()
    for number, source in enumerate([*sources, own.mirrored(mirror)], 1):
        shift = graph.extended(own.vertices - source.vertices, graph.in_large_parts(own.seen & source.seen, _COMMON))
        shift = np.clip(shift, -_MOST_SHIFT, _MOST_SHIFT)
        vertex = np.where((~seen & source.seen)[:, None], source.vertices + shift, vertex)
        seen |= source.seen
        new = (origin < 0) & source.seen_texels
        texel[new] = (source.texels + known.interpolate(shift, registration.triangles))[new]
        origin[new] = number
    of_vertex = np.zeros(len(vertex), np.int64)
    of_vertex[topology.triangles] = topology.triangle_material[:, None]
    vertex, reached = graph.spread(vertex, seen, of_vertex)
    corners = registration.triangles[known.face]
    for number, present in ((len(sources) + 1, seen), (len(sources) + 2, reached)):
        new = (origin < 0) & present[corners].all(1)
        texel[new] = known.interpolate(vertex, registration.triangles)[new]
        origin[new] = number
    origin[origin < 0] = len(sources) + 3
    texture = registration.texture.astype(np.float64).reshape(-1, 3).copy()
    texture[known.index] = np.clip(texel, 0, None)
    mask = np.full((size, size), FILLED, np.uint8)
    mask.reshape(-1)[known.index[own.seen_texels]] = 0
    names = [*(f"registration {k}" for k in range(1, len(sources) + 1)), "the other side", "surroundings", "nothing"]
    counts = np.bincount(origin, minlength=len(names) + 1)[1:]
    shares = {name: float(share) for name, share in zip(names, counts / max(1, int(counts.sum())), strict=True)}
    filled = _grown(texture.reshape(size, size, 3), known)
    return FilledTexture(texture=filled.astype(np.float32), unseen=mask, shares=shares)


@dataclass(frozen=True, kw_only=True, eq=False)
class _Colours:
    """Colours of vertices and of the K texels in charts, and which were seen."""

    vertices: Float[np.ndarray, "V 3"]
    seen: Bool[np.ndarray, "V"]
    texels: Float[np.ndarray, "K 3"]
    seen_texels: Bool[np.ndarray, "K"]

    @classmethod
    def of(
        cls, texture: np.ndarray, seen: Bool[np.ndarray, "V"], known: Texels, triangles: Int[np.ndarray, "F 3"]
    ) -> "_Colours":
        values = np.nan_to_num(texture.reshape(-1, 3)[known.index].astype(np.float64))
        corners = triangles[known.face]
        inside = seen[corners].all(1)
        weight = np.where(inside[:, None], known.barycentric, 1e-9 * known.barycentric)
        rows = np.repeat(np.arange(len(corners)), 3)
        to_vertices = sp.csr_matrix((weight.ravel(), (corners.ravel(), rows)), (len(seen), len(corners)))
        total = np.asarray(to_vertices.sum(1)).ravel()
        vertices = (to_vertices @ values) / np.maximum(total, 1e-30)[:, None]
        return cls(vertices=vertices, seen=seen & (total > 1e-6), texels=values, seen_texels=inside)

    def mirrored(self, mirror: Int[np.ndarray, "V"]) -> "_Colours":
        """The other side's colours, of vertices only."""
        nowhere = np.zeros(len(self.seen_texels), bool)
        seen = self.seen[mirror]
        return _Colours(vertices=self.vertices[mirror], seen=seen, texels=self.texels, seen_texels=nowhere)


class _Graph:
    """The mesh's edges, on which values are extended harmonically."""

    def __init__(self, topology: Topology):
        edges = edges_of(topology.triangles)[0]
        count = topology.vertex_count
        ends = np.concatenate([edges, edges[:, ::-1]]).T
        self._adjacency = sp.csr_matrix((np.ones(ends.shape[1]), ends), (count, count))
        self._component = connected_components(self._adjacency, directed=False)[1]

    def extended(self, values: Float[np.ndarray, "V 3"], given: Bool[np.ndarray, "V"]) -> Float[np.ndarray, "V 3"]:
        """Extend the given values to all vertices of the components that have some; zero elsewhere."""
        result = np.where(given[:, None], values, 0.0)
        free = np.flatnonzero(self.reached(given) & ~given)
        if len(free):
            rows = self._adjacency[free]
            matrix = sp.diags(np.asarray(rows.sum(1)).ravel()) - rows[:, free]
            result[free] = splu(matrix.tocsc()).solve(rows @ result)
        return result

    def reached(self, given: Bool[np.ndarray, "V"]) -> Bool[np.ndarray, "V"]:
        """The vertices of the components that have given ones."""
        return np.isin(self._component, np.unique(self._component[given]))

    def in_large_parts(self, chosen: Bool[np.ndarray, "V"], least: int) -> Bool[np.ndarray, "V"]:
        """Those of some vertices that are in a component with at least so many of them."""
        counts = np.bincount(self._component[chosen], minlength=self._component.max() + 1)
        return chosen & (counts >= least)[self._component]

    def spread(
        self, values: Float[np.ndarray, "V 3"], given: Bool[np.ndarray, "V"], material: Int[np.ndarray, "V"]
    ) -> tuple[Float[np.ndarray, "V 3"], Bool[np.ndarray, "V"]]:
        """Extend the given values; components without any get the mean of their material. Also: which have values."""
        result, reached = self.extended(values, given), self.reached(given)
        for number in np.unique(material):
            source = given & (material == number)
            lost = (material == number) & ~reached
            if source.any() and lost.any():
                result[lost] = values[source].mean(0)
                reached |= lost
        return np.where(reached[:, None], result, values), reached


def _resized(texture: Float[np.ndarray, "S S 3"], size: int) -> np.ndarray:
    return texture if len(texture) == size else cv2.resize(texture, (size, size), interpolation=cv2.INTER_LINEAR)


def _grown(texture: Float[np.ndarray, "R R 3"], known: Texels) -> Float[np.ndarray, "R R 3"]:
    """Texels between the charts get the nearest chart's, so that interpolation at its rim reads no other colour."""
    from scipy.ndimage import distance_transform_edt

    outside = known.image(np.zeros(len(known.index), bool), True)
    row, column = distance_transform_edt(outside, return_distances=False, return_indices=True)
    return texture[row, column]
