"""Heads with intersecting parts, the minimization of the self-intersection penalty, and an independent depth measure.

The measure shares no code with the penalty: winding numbers by solid angles give the points inside a part, exact
closest points their depth.
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree
from scipy.spatial.distance import cdist
from torch import Tensor

from registration.fit.optimizer import AdamUniformBlock, minimize
from registration.fit.recipes import Rate
from registration.fit.variables import skin_triangles, skin_vertices
from registration.frames import MM_PER_M
from registration.geometry.closest_point import closest_points
from registration.geometry.large_steps import LargeSteps
from registration.geometry.topology import edges, vertex_normals
from registration.geometry.winding import closed
from registration.losses.self_intersection import SelfIntersectionPenalty
from registration.model import regions
from registration.model.gnm_npz import GNMData

_REFRESH_EVERY = 10
_SMOOTHING_M = 4e-3
_BULGE_M = 5e-3  # smoothing length of displacements
_L2 = 1e-3  # mm^2 of penalty for a vertex moved by 1 mm


@dataclass(frozen=True, kw_only=True)
class Recovered:
    """A head before and after the penalty was minimized over the skin's offsets; metres."""

    before: Float[Tensor, "V 3"]
    after: Float[Tensor, "V 3"]
    history: list[float]  # of the penalty, mm^2

    def max_motion_mm(self, members: Bool[np.ndarray, "V"]) -> float:
        """Return the largest motion of the given vertices."""
        return float((self.after - self.before)[torch.as_tensor(members)].norm(dim=1).max()) * MM_PER_M


def translated_part(data: GNMData, members: Bool[np.ndarray, "V"], by_mm: tuple[float, ...]) -> Float[Tensor, "V 3"]:
    """Return the template with the given vertices translated."""
    vertices = torch.as_tensor(data.template_vertex_positions).clone()
    vertices[torch.as_tensor(members)] += torch.tensor(by_mm) / MM_PER_M
    return vertices


def displaced(
    data: GNMData, members: Bool[np.ndarray, "V"], displacement: Float[np.ndarray, "V 3"]
) -> Float[Tensor, "V 3"]:
    """Return the template with the given skin displaced by `displacement` (metres), fading smoothly around it."""
    skin = skin_vertices(data)
    weight = torch.as_tensor(members[skin], dtype=torch.float32)[:, None].expand(-1, 3).contiguous()
    weight = _steps(data, skin, _BULGE_M).displacement(weight)[:, :1]
    vertices = torch.as_tensor(data.template_vertex_positions).clone()
    vertices[torch.as_tensor(skin)] += (weight / weight.max()).clamp(0, 1) * torch.as_tensor(displacement[skin]).float()
    return vertices


def raised_lower_lip(data: GNMData, by_mm: float) -> Float[Tensor, "V 3"]:
    """Return the template with the lower lip pushed up into the upper lip."""
    up = np.zeros((len(data.template_vertex_positions), 3))
    up[:, 1] = by_mm / MM_PER_M
    return displaced(data, regions.group(data, "lower_lip") > 0.5, up)


def pressed_lid(data: GNMData, by_mm: float) -> Float[Tensor, "V 3"]:
    """Return the template with the left eye's upper lid pushed towards the eyeball's centre."""
    points = data.template_vertex_positions.astype(np.float64)
    shell = regions.eyeball_shells(data)[0]
    offset = points - points[shell].mean(0)
    distance = np.linalg.norm(offset, axis=1)
    x, y, z = (offset / np.median(distance[shell])).T  # models differ in the size of their eyes
    lid = regions.exterior(data) & (x**2 + y**2 + z**2 < 1.34**2) & (np.abs(x) < 0.58) & (y > 0.145) & (z > 0.58)
    return displaced(data, lid, -offset / distance[:, None] * by_mm / MM_PER_M)


def recover(data: GNMData, before: Float[Tensor, "V 3"], *, steps: int, rate: float) -> Recovered:
    """Minimize the penalty over large-steps offsets of the skin, with a weak quadratic penalty of the offsets."""
    skin = skin_vertices(data)
    index, large = torch.as_tensor(skin), _steps(data, skin, _SMOOTHING_M)
    penalty = SelfIntersectionPenalty(data, torch.device("cpu"))
    latent = torch.zeros(len(skin), 3, requires_grad=True)

    def vertices() -> Tensor:
        return before.index_add(0, index, large.displacement(latent))

    def objective(step: int) -> dict[str, Tensor]:
        posed = vertices()
        if step % _REFRESH_EVERY == 0:
            penalty.update_candidates(posed)
        crossing = torch.stack(list(penalty(posed).values())).sum()
        return {"crossing": crossing, "l2": _L2 * MM_PER_M**2 * (posed - before).square().sum()}

    history, failure = minimize([AdamUniformBlock(latent, Rate(start=rate, end=rate / 10))], objective, steps)
    assert failure is None, failure
    return Recovered(before=before, after=vertices().detach(), history=history["crossing"])


def cheeks(data: GNMData) -> Bool[np.ndarray, "V"]:
    """The cheeks from 2 mm beside the lips, which overlap them in some models."""
    members = np.any([regions.group(data, f"{side}_cheek_region") > 0.5 for side in ("left", "right")], axis=0)
    points = data.template_vertex_positions
    return members & (cKDTree(points[np.logical_or(*regions.lips(data))]).query(points)[0] > 2e-3)


def lip_depths_mm(data: GNMData, vertices: Float[Tensor, "V 3"]) -> Float[np.ndarray, "V"]:
    """Return the depth of each lip vertex inside the other lip; 0 for all other vertices.

    At the mouth's corners, where the lips are connected, vertices next to the other lip are excluded.
    """
    points, skin = vertices.numpy().astype(np.float64), _skin(data)
    height = data.template_vertex_positions[:, 1]
    lips, depth = regions.lips(data), np.zeros(len(points))
    slit = np.mean([height[regions.group(data, name) > 0.5].mean() for name in ("upper_lip", "lower_lip")])
    for lip, other, above in ((*lips, False), (*lips[::-1], True)):
        # The other lip with the oral lining behind it, selected by its height in the template.
        patch = other | (regions.mouth_lining(data) & ((height > slit) == above))
        distance = np.full(len(points), np.inf)
        lip = lip & ~np.isin(np.arange(len(points)), skin[other[skin].any(1)])
        distance[lip] = closest_points(points[lip], points, skin[patch[skin].all(1)])[0] * MM_PER_M
        near = np.flatnonzero(distance < 2.0)
        inside = near[_inside_skin(vertices, skin, near)]
        depth[inside] = distance[inside]
    return depth


def ear_depths_mm(data: GNMData, vertices: Float[Tensor, "V 3"]) -> Float[np.ndarray, "V"]:
    """Return the depth of each vertex of the left ear inside the head; 0 for all other vertices."""
    points, skin, ears = vertices.numpy().astype(np.float64), _skin(data), regions.ears(data)
    head = regions.exterior(data) & ~ears
    left = np.flatnonzero(ears & (data.template_vertex_positions[:, 0] > 0))
    distance, depth = closest_points(points[left], points, skin[head[skin].all(1)])[0] * MM_PER_M, np.zeros(len(points))
    near = np.flatnonzero(distance < 2.0)
    inside = near[_inside_skin(vertices, skin, left[near])]
    depth[left[inside]] = distance[inside]
    return depth


def eyeball_depths_mm(data: GNMData, vertices: Float[Tensor, "V 3"]) -> Float[np.ndarray, "V"]:
    """Return the depth of each skin vertex inside the left eyeball's outer shell; 0 outside."""
    points, shell = vertices.numpy().astype(np.float64), regions.eyeball_shells(data)[0]
    ball = data.triangles[shell[data.triangles].all(1)].astype(np.int64)
    near = regions.exterior(data) & (np.linalg.norm(points - points[shell].mean(0), axis=1) < 18e-3)
    depth = np.zeros(len(points))
    depth[near] = closest_points(points[near], points, ball)[0] * MM_PER_M * (winding(points[near], points[ball]) > 0.5)
    return depth


def teeth_of(data: GNMData) -> list[Int[np.ndarray, "_ 3"]]:
    """Return the triangles of each tooth."""
    mesh = data.triangles[regions.teeth(data)[data.triangles].all(1)].astype(np.int64)
    ends = np.concatenate([mesh[:, [0, 1]], mesh[:, [1, 2]]]).T
    _, piece = connected_components(coo_matrix((np.ones(ends.shape[1]), ends)), directed=False)
    return [mesh[piece[mesh[:, 0]] == number] for number in np.unique(piece[mesh])]


def part_depths_mm(
    points: Float[np.ndarray, "P 3"], vertices: Float[np.ndarray, "V 3"], parts: list[Int[np.ndarray, "_ 3"]]
) -> Float[np.ndarray, "P"]:
    """Return the depth of points in any of the parts, such as teeth; 0 outside. Openings are closed by cones."""
    depth = np.zeros(len(points))
    for part in parts:
        corners = vertices[part]
        boxed = np.flatnonzero(((points > corners.min((0, 1))) & (points < corners.max((0, 1)))).all(1))
        if len(boxed):
            solid, faces = closed(vertices, part)
            inside = winding(points[boxed], solid[faces]) > 0.5
            distance_mm = closest_points(points[boxed], vertices, part)[0] * MM_PER_M
            depth[boxed] = np.maximum(depth[boxed], np.where(inside, distance_mm, 0.0))
    return depth


def winding(points: Float[np.ndarray, "P 3"], corners: Float[np.ndarray, "F 3 3"]) -> Float[np.ndarray, "P"]:
    """Return generalized winding numbers by solid angles (van Oosterom and Strackee, 1983)."""
    a, b, c = np.moveaxis(corners, 1, 0)
    normals = np.cross(b - a, c - a)
    heights = (normals * a).sum(1)
    ab, bc, ca = (np.square(start - end).sum(1) for start, end in ((a, b), (b, c), (c, a)))
    total = np.zeros(len(points))
    for k, point in enumerate(points):
        la, lb, lc = (cdist(point[None], corner)[0] for corner in (a, b, c))
        aa, bb, cc = la * la, lb * lb, lc * lc
        # The scalar products of the three offsets, by the law of cosines.
        below = la * lb * lc + ((aa + bb - ab) * lc + (bb + cc - bc) * la + (cc + aa - ca) * lb) / 2
        total[k] = np.arctan2(heights - normals @ point, below).sum()
    return total / (2 * np.pi)


def _inside_skin(
    vertices: Float[Tensor, "V 3"], skin: Int[np.ndarray, "F 3"], members: Int[np.ndarray, "M"]
) -> Bool[np.ndarray, "M"]:
    """Whether vertices of the skin, moved slightly along their normals, lie inside the skin."""
    normals = vertex_normals(vertices, torch.as_tensor(skin)).numpy()[members]
    points = vertices.numpy().astype(np.float64)
    return winding(points[members] + 2e-5 * normals, points[skin]) > 0.5


def _skin(data: GNMData) -> Int[np.ndarray, "F 3"]:
    return data.triangles[(regions.group(data, "skin") > 0.5)[data.triangles].all(1)].astype(np.int64)


def _steps(data: GNMData, skin: Int[np.ndarray, "S"], smoothing_m: float) -> LargeSteps:
    points = data.template_vertex_positions[skin]
    triangles = skin_triangles(data.triangles, skin, len(data.template_vertex_positions))
    ends = edges(triangles).vertices
    edge = float(np.median(np.linalg.norm(points[ends[:, 0]] - points[ends[:, 1]], axis=1)))
    return LargeSteps(triangles, len(skin), edge_length_m=edge, smoothing_m=smoothing_m, device=torch.device("cpu"))
