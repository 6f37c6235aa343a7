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
from torch import Tensor

from registration.fit.optimizer import AdamUniformBlock, minimize
from registration.fit.recipes import Rate
from registration.fit.variables import skin_triangles, skin_vertices
from registration.frames import MM_PER_M
from registration.geometry.closest_point import closest_points
from registration.geometry.large_steps import LargeSteps
from registration.geometry.topology import edges, vertex_normals
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
    centre = points[regions.eyeball_shells(data)[0]].mean(0)
    offset = points - centre
    distance = np.linalg.norm(offset, axis=1)
    lid = regions.exterior(data) & (distance < 18.5e-3) & (np.abs(offset[:, 0]) < 8e-3)
    lid &= (offset[:, 1] > 2e-3) & (offset[:, 2] > 8e-3)
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
    return np.any([regions.group(data, f"{side}_cheek_region") > 0.5 for side in ("left", "right")], axis=0)


def lip_depths_mm(data: GNMData, vertices: Float[Tensor, "V 3"]) -> Float[np.ndarray, "V"]:
    """Return the depth of each lip vertex inside the other lip; 0 for all other vertices.

    At the mouth's corners, where the lips are connected, vertices next to the other lip are excluded.
    """
    points, skin = vertices.numpy().astype(np.float64), _skin(data)
    normals = vertex_normals(vertices, torch.as_tensor(skin)).numpy()
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
        inside = winding(points[near] + 2e-5 * normals[near], points[skin]) > 0.5
        depth[near[inside]] = distance[near[inside]]
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


def tooth_depths_mm(
    points: Float[np.ndarray, "P 3"], vertices: Float[np.ndarray, "V 3"], teeth: list[Int[np.ndarray, "_ 3"]]
) -> Float[np.ndarray, "P"]:
    """Return the depth of points in any of the teeth; 0 outside. Open roots are closed by a cone."""
    depth = np.zeros(len(points))
    for tooth in teeth:
        corners = vertices[tooth]
        boxed = np.flatnonzero(((points > corners.min((0, 1))) & (points < corners.max((0, 1)))).all(1))
        if len(boxed):
            inside = winding(points[boxed], np.concatenate([corners, _cone(vertices, tooth)])) > 0.5
            distance_mm = closest_points(points[boxed], vertices, tooth)[0] * MM_PER_M
            depth[boxed] = np.maximum(depth[boxed], np.where(inside, distance_mm, 0.0))
    return depth


def _cone(vertices: Float[np.ndarray, "V 3"], part: Int[np.ndarray, "_ 3"]) -> Float[np.ndarray, "_ 3 3"]:
    """Return a shallow cone of triangles that closes the opening of a part."""
    ends = {(a, b) for a, b in part[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2).tolist()}
    boundary = vertices[np.array([(b, a) for a, b in ends if (b, a) not in ends], int).reshape(-1, 2)]
    if not len(boundary):
        return np.empty((0, 3, 3))
    centre = boundary.mean((0, 1))
    out = centre - vertices[part].mean((0, 1))
    tip = centre + 0.5 * np.linalg.norm(boundary[:, 0] - centre, axis=1).mean() * out / np.linalg.norm(out)
    return np.stack([boundary[:, 0], boundary[:, 1], np.broadcast_to(tip, (len(boundary), 3))], 1)


def winding(points: Float[np.ndarray, "P 3"], corners: Float[np.ndarray, "F 3 3"]) -> Float[np.ndarray, "P"]:
    """Return generalized winding numbers by solid angles (van Oosterom and Strackee, 1983)."""
    total = np.zeros(len(points))
    for k, point in enumerate(points):
        a, b, c = np.moveaxis(corners - point, 1, 0)
        la, lb, lc = (np.linalg.norm(side, axis=1) for side in (a, b, c))
        dot = (np.einsum("fc,fc->f", *pair) for pair in ((a, b), (b, c), (c, a)))
        weights = (lc, la, lb)
        below = la * lb * lc + sum(d * w for d, w in zip(dot, weights, strict=True))
        total[k] = np.arctan2(np.einsum("fc,fc->f", a, np.cross(b, c)), below).sum()
    return total / (2 * np.pi)


def _skin(data: GNMData) -> Int[np.ndarray, "F 3"]:
    return data.triangles[(regions.group(data, "skin") > 0.5)[data.triangles].all(1)].astype(np.int64)


def _steps(data: GNMData, skin: Int[np.ndarray, "S"], smoothing_m: float) -> LargeSteps:
    points = data.template_vertex_positions[skin]
    triangles = skin_triangles(data.triangles, skin, len(data.template_vertex_positions))
    ends = edges(triangles).vertices
    edge = float(np.median(np.linalg.norm(points[ends[:, 0]] - points[ends[:, 1]], axis=1)))
    return LargeSteps(triangles, len(skin), edge_length_m=edge, smoothing_m=smoothing_m, device=torch.device("cpu"))
