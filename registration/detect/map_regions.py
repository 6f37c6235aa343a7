"""Where on a model the landmarks of a scheme may lie: skin; lips, lids and irises on their own parts."""

import numpy as np
from jaxtyping import Bool, Float, Int

from registration.detect import face478_points as named
from registration.detect.face478 import SCHEME as FACE478
from registration.detect.map_solve import Regions
from registration.geometry.topology import edges, grown
from registration.model import regions
from registration.model.gnm_npz import GNMData

_EDGE_RINGS = 2
_LID_BORDER_M = 5e-4  # by which a lid's points may lie beyond the line between the eye's corners


def regions_of(data: GNMData, scheme: str) -> Regions:
    """Return where the landmarks of a scheme may lie: on the face's skin, and those with names on their own part."""
    skin = regions.head_skin(data) & ~regions.ears(data)
    if scheme != FACE478:
        return Regions(skin=skin, own={})
    painted = np.max([regions.group(data, name) for name in ("irises", "pupils", "scleras")], axis=0) > 0.5
    left, right = (ball & painted for ball in regions.eyeballs(data))
    own = dict.fromkeys((named.LEFT_PUPIL, *named.LEFT_IRIS), left)
    own |= dict.fromkeys((named.RIGHT_PUPIL, *named.RIGHT_IRIS), right)
    upper_lip, lower_lip = (lip & skin for lip in regions.lips(data))
    for outer, inner, lip in (  # the corners belong to both
        (named.LIPS_OUTER_UPPER, named.LIPS_INNER_UPPER, upper_lip),
        (named.LIPS_OUTER_LOWER, named.LIPS_INNER_LOWER, lower_lip),
    ):
        own |= dict.fromkeys(outer[1:-1] + inner[1:-1], lip)
    for side, upper, lower in (
        (True, named.LEFT_LID_UPPER, named.LEFT_LID_LOWER),
        (False, named.RIGHT_LID_UPPER, named.RIGHT_LID_LOWER),
    ):
        lids = _upper_and_lower(data, skin, left=side)
        own |= dict.fromkeys(upper[1:-1], lids[0]) | dict.fromkeys(lower[1:-1], lids[1])
    return Regions(skin=skin, own={index: allowed for index, allowed in own.items() if allowed.any()})


def lid_rims(data: GNMData) -> Bool[np.ndarray, "V"]:
    """Return the vertices of the lids' edges: exterior skin that borders on the eye sockets."""
    outside, socket = regions.exterior(data), regions.eye_sockets(data)
    a, b = edges(data.triangles).vertices.T
    rim = np.zeros(len(outside), bool)
    rim[a[outside[a] & socket[b]]] = True
    rim[b[outside[b] & socket[a]]] = True
    return rim


def lid_edges(data: GNMData, *, left: bool) -> tuple[Int[np.ndarray, "U"], Int[np.ndarray, "W"]]:
    """Return the vertices of one eye's upper and of its lower lid that may border the visible opening.

    The skin of a lid ends behind its edge, on the eyeball: the rims and `_EDGE_RINGS` rings of skin around them.
    """
    outside, near = regions.exterior(data), lid_rims(data)
    for _ in range(_EDGE_RINGS):
        near = grown(data.triangles, near, 1) & outside
    height = _above_the_corners(data, left=left)
    return np.flatnonzero(near & (height > 0)), np.flatnonzero(near & (height < 0))


def _upper_and_lower(
    data: GNMData, skin: Bool[np.ndarray, "V"], *, left: bool
) -> tuple[Bool[np.ndarray, "V"], Bool[np.ndarray, "V"]]:
    """The skin of one eye's lids above and below the line between its corners, in the template."""
    height = _above_the_corners(data, left=left)
    lids = skin & (regions.lids(data) > 0)
    return lids & (height > -_LID_BORDER_M), lids & (height < _LID_BORDER_M)


def _above_the_corners(data: GNMData, *, left: bool) -> Float[np.ndarray, "V"]:
    """The template's height above the line between the corners of one eye, metres; NaN on the other side."""
    points = data.template_vertex_positions.astype(np.float64)
    side = (points[:, 0] > 0) == left
    rim = np.flatnonzero(lid_rims(data) & side)
    if not len(rim):
        return np.full(len(points), np.nan)
    inner, outer = points[rim[[points[rim, 0].argmin(), points[rim, 0].argmax()]]]
    slope = (outer[1] - inner[1]) / max(outer[0] - inner[0], 1e-6)
    return np.where(side, points[:, 1] - (inner[1] + slope * (points[:, 0] - inner[0])), np.nan)
