"""Soft masks of the regions that expression bases are built for, and mirror images [GNM, Head Expression]."""

from collections.abc import Mapping

import numpy as np
import scipy.sparse as sp
from jaxtyping import Bool, Float, Int
from scipy.sparse.csgraph import dijkstra

from registration.geometry.topology import edges as edges_of
from registration.model import regions
from registration.model.gnm_npz import GNMData

REGIONS = ("left_eye_region", "right_eye_region", "lower_face_region")
FLIP = np.array([-1.0, 1.0, 1.0])  # a mirror image's coordinates
_BLEND = 10e-3  # metres along the surface, across which one region fades into the next
_UPPER = ("forehead", "middle_brow", "left_brow", "right_brow", "left_temple", "right_temple", "left_orbital")
_UPPER_REGIONS = tuple(f"{name}_region" for name in (*_UPPER, "right_orbital"))


def soft_masks(
    vertices: Float[np.ndarray, "V 3"],
    edges: Int[np.ndarray, "E 2"],
    mirror: Int[np.ndarray, "V"],
    groups: Mapping[str, Bool[np.ndarray, "V"]],
) -> Float[np.ndarray, "3 V"]:
    """The share of each of `REGIONS` in every vertex of the skin; columns sum to one, the right mirrors the left."""
    length = np.linalg.norm(vertices[edges[:, 0]] - vertices[edges[:, 1]], axis=1)
    graph = sp.csr_matrix((length, (edges[:, 0], edges[:, 1])), (len(vertices),) * 2)
    upper = np.any([groups[name] for name in (*_UPPER_REGIONS, "eye_sockets")], axis=0)
    scalp = ~groups["hockey_mask"] & ~groups["ears"] & (vertices[:, 1] > vertices[upper, 1].max())
    upper |= scalp & groups["skin_exterior"]
    return _split(graph, upper, vertices[:, 0], mirror)


def regional_masks(data: GNMData) -> Float[np.ndarray, "3 V"]:
    """The same of a model file, whose groups say where the eye regions are; zero where there is no skin.

    The file's groups may be hard or soft, and may overlap or leave skin out: only their border is taken.
    """
    skin, mirror = regions.skin(data), data.mirror_indices
    vertices = data.template_vertex_positions.astype(np.float64)
    vertices = (vertices + vertices[mirror] * FLIP) / 2
    upper = regions.expression_skin(data)
    edges = edges_of(data.triangles[skin[data.triangles].all(1)]).vertices
    length = np.linalg.norm(vertices[edges[:, 0]] - vertices[edges[:, 1]], axis=1)
    graph = sp.csr_matrix((length, (edges[:, 0], edges[:, 1])), (len(vertices),) * 2)
    return _split(graph, upper | upper[mirror], vertices[:, 0], mirror) * skin


def _split(
    graph: sp.csr_matrix, upper: Bool[np.ndarray, "V"], x: Float[np.ndarray, "V"], mirror: Int[np.ndarray, "V"]
) -> Float[np.ndarray, "3 V"]:
    left_of = smoothstep(0.5 + x / _BLEND)
    eyes = _fade(graph, upper)
    eyes = (eyes + eyes[mirror]) / 2
    return np.stack([eyes * left_of, eyes * (1 - left_of), 1 - eyes])


def _fade(graph: sp.csr_matrix, inside: Bool[np.ndarray, "V"]) -> Float[np.ndarray, "V"]:
    """1 inside and 0 outside, passing through 1/2 on the border."""
    reach = [dijkstra(graph, directed=False, indices=np.flatnonzero(s), min_only=True) for s in (inside, ~inside)]
    return smoothstep(0.5 + (reach[1] - reach[0]) / _BLEND)


def smoothstep(share: Float[np.ndarray, "*S"]) -> Float[np.ndarray, "*S"]:
    """0 below 0, 1 above 1, and smooth in between: 3 t^2 - 2 t^3."""
    t = np.clip(share, 0, 1)
    return t * t * (3 - 2 * t)


def mirrored(basis: Float[np.ndarray, "K V 3"], mirror: Int[np.ndarray, "V"]) -> Float[np.ndarray, "K V 3"]:
    """The same displacements on the other side of the head: P diag(-1, 1, 1) E."""
    return basis[:, mirror] * FLIP
