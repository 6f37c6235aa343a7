"""Soft masks of the regions of expression bases, and mirror images [GNM, Head Expression]; docs/algorithms.md,
"Expression basis"."""

from collections.abc import Mapping

import numpy as np
from jaxtyping import Bool, Float, Int

from registration.geometry.geodesic import edge_distances
from registration.geometry.smoothstep import smoothstep
from registration.geometry.topology import edges as edges_of
from registration.model import regions
from registration.model.gnm_npz import GNMData

REGIONS = ("left_eye_region", "right_eye_region", "lower_face_region")
FLIP = np.array([-1.0, 1.0, 1.0])  # a mirror image's coordinates
_BLEND_M = 10e-3  # geodesic width of the transition between regions
_FADE_M = (30e-3, 60e-3)  # from the face along the outer skin, over which masks fall to zero
_UPPER = ("forehead", "middle_brow", "left_brow", "right_brow", "left_temple", "right_temple", "left_orbital")
_UPPER_REGIONS = tuple(f"{name}_region" for name in (*_UPPER, "right_orbital"))


def soft_masks(
    vertices: Float[np.ndarray, "V 3"],
    edges: Int[np.ndarray, "E 2"],
    mirror: Int[np.ndarray, "V"],
    groups: Mapping[str, Bool[np.ndarray, "V"]],
) -> Float[np.ndarray, "3 V"]:
    """Return the mask of each of `REGIONS`; the masks of a vertex sum to one, the right eye's mirrors the left eye's.

    Args:
        vertices: of the skin, metres, symmetric about x = 0.
        edges: of the skin.
        mirror: each vertex' mirror image.
        groups: official vertex groups by name.
    """
    upper = np.any([groups[name] for name in (*_UPPER_REGIONS, "eye_sockets")], axis=0)
    scalp = ~groups["hockey_mask"] & ~groups["ears"] & (vertices[:, 1] > vertices[upper, 1].max())
    upper |= scalp & groups["skin_exterior"]
    return _split(vertices, edges, upper, mirror)


def regional_masks(data: GNMData) -> Float[np.ndarray, "3 V"]:
    """Return the masks of `REGIONS` for a model, by its vertex groups of eye regions; zero off the skin.

    The groups may be hard or soft, overlap or not cover the skin: only their border is used. Masks sum to one on the
    face and about it, and fall to zero on the neck, the chest and the scalp, which expressions do not move.
    """
    skin, mirror = regions.skin(data), data.mirror_indices
    vertices = data.template_vertex_positions.astype(np.float64)
    vertices = (vertices + vertices[mirror] * FLIP) / 2
    upper = regions.expression_skin(data)
    edges = edges_of(data.triangles[skin[data.triangles].all(1)]).vertices
    away = smoothstep(*_FADE_M, edge_distances(vertices, edges, regions.face(data)))
    near = np.where(regions.exterior(data), 1 - (away + away[mirror]) / 2, 1)  # linings are far along the surface
    return _split(vertices, edges, upper | upper[mirror], mirror) * near * skin


def _split(
    vertices: Float[np.ndarray, "V 3"],
    edges: Int[np.ndarray, "E 2"],
    upper: Bool[np.ndarray, "V"],
    mirror: Int[np.ndarray, "V"],
) -> Float[np.ndarray, "3 V"]:
    left_of = smoothstep(0, 1, 0.5 + vertices[:, 0] / _BLEND_M)
    # A mask that is 1 inside, 0 outside and 1/2 on the border.
    to_upper, to_lower = (edge_distances(vertices, edges, side) for side in (upper, ~upper))
    eyes = smoothstep(0, 1, 0.5 + (to_lower - to_upper) / _BLEND_M)
    eyes = (eyes + eyes[mirror]) / 2
    return np.stack([eyes * left_of, eyes * (1 - left_of), 1 - eyes])


def mirrored(basis: Float[np.ndarray, "K V 3"], mirror: Int[np.ndarray, "V"]) -> Float[np.ndarray, "K V 3"]:
    """Return the mirror images of displacements or positions, P diag(-1, 1, 1) E.

    Args:
        basis: of the model, metres, the model's frame.
        mirror: each vertex' mirror image, the permutation P.
    """
    return basis[:, mirror] * FLIP
