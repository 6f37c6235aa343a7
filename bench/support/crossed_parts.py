"""Heads whose parts run into one another, what is left after the penalty was minimized, and a measure of its own.

That measure shares nothing with the penalty: winding numbers by solid angles tell what is inside, the exact closest
point how deep.
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
_BULGE_M = 5e-3  # smoothing length of what is displaced
_L2 = 1e-3  # mm^2 of penalty for a vertex moved by 1 mm


@dataclass(frozen=True, kw_only=True)
class Recovered:
    """A head before and after; offsets are the skin's, metres."""

    before: Float[Tensor, "V 3"]
    after: Float[Tensor, "V 3"]
    history: list[float]  # the penalty, mm^2

    def moved_mm(self, members: Bool[np.ndarray, "V"]) -> float:
        """The largest motion among some vertices."""
        return float((self.after - self.before)[torch.as_tensor(members)].norm(dim=1).max()) * MM_PER_M


def moved(data: GNMData, members: Bool[np.ndarray, "V"], by_mm: tuple[float, ...]) -> Float[Tensor, "V 3"]:
    """The template with some vertices moved as one body."""
    vertices = torch.as_tensor(data.template_vertex_positions).clone()
    vertices[torch.as_tensor(members)] += torch.tensor(by_mm) / MM_PER_M
    return vertices


def displaced(data: GNMData, members: Bool[np.ndarray, "V"], move: Float[np.ndarray, "V 3"]) -> Float[Tensor, "V 3"]:
    """The template with some skin displaced by `move` (metres), fading smoothly around it."""
    skin = skin_vertices(data)
    weight = torch.as_tensor(members[skin], dtype=torch.float32)[:, None].expand(-1, 3).contiguous()
    weight = _steps(data, skin, _BULGE_M).displacement(weight)[:, :1]
    vertices = torch.as_tensor(data.template_vertex_positions).clone()
    vertices[torch.as_tensor(skin)] += (weight / weight.max()).clamp(0, 1) * torch.as_tensor(move[skin]).float()
    return vertices


def raised_lower_lip(data: GNMData, by_mm: float) -> Float[Tensor, "V 3"]:
    """The lower lip pushed up into the upper one."""
    up = np.zeros((len(data.template_vertex_positions), 3))
    up[:, 1] = by_mm / MM_PER_M
    return displaced(data, regions.group(data, "lower_lip") > 0.5, up)


def pressed_lid(data: GNMData, by_mm: float) -> Float[Tensor, "V 3"]:
    """The upper lid of the left eye pushed towards the eyeball's centre."""
    points = data.template_vertex_positions.astype(np.float64)
    centre = points[regions.eyeball_shells(data)[0]].mean(0)
    away = points - centre
    distance = np.linalg.norm(away, axis=1)
    lid = regions.exterior(data) & (distance < 18.5e-3) & (np.abs(away[:, 0]) < 8e-3)
    lid &= (away[:, 1] > 2e-3) & (away[:, 2] > 8e-3)
    return displaced(data, lid, -away / distance[:, None] * by_mm / MM_PER_M)


def recover(data: GNMData, before: Float[Tensor, "V 3"], *, steps: int, rate: float) -> Recovered:
    """Minimise the penalty over large-steps offsets of the skin, which a weak pull keeps where they began."""
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
    """How deep each vertex of a lip lies inside the other lip; 0 for what is in none.

    Where the two lips are one, at the corners, a vertex next to the other lip is not asked.
    """
    points, skin = vertices.numpy().astype(np.float64), _skin(data)
    normals = vertex_normals(vertices, torch.as_tensor(skin)).numpy()
    height = data.template_vertex_positions[:, 1]
    lips, depth = regions.lips(data), np.zeros(len(points))
    slit = np.mean([height[regions.group(data, name) > 0.5].mean() for name in ("upper_lip", "lower_lip")])
    for lip, other, above in ((*lips, False), (*lips[::-1], True)):
        # The other lip with the lining behind it, told by its place in the template.
        patch = other | (regions.mouth_lining(data) & ((height > slit) == above))
        distance = np.full(len(points), np.inf)
        lip = lip & ~np.isin(np.arange(len(points)), skin[other[skin].any(1)])
        distance[lip] = closest_points(points[lip], points, skin[patch[skin].all(1)])[0] * MM_PER_M
        near = np.flatnonzero(distance < 2.0)
        inside = winding(points[near] + 2e-5 * normals[near], points[skin]) > 0.5
        depth[near[inside]] = distance[near[inside]]
    return depth


def eyeball_depths_mm(data: GNMData, vertices: Float[Tensor, "V 3"]) -> Float[np.ndarray, "V"]:
    """How deep each vertex of the skin lies inside the left eyeball's outer shell; 0 outside."""
    points, shell = vertices.numpy().astype(np.float64), regions.eyeball_shells(data)[0]
    ball = data.triangles[shell[data.triangles].all(1)].astype(np.int64)
    near = regions.exterior(data) & (np.linalg.norm(points - points[shell].mean(0), axis=1) < 18e-3)
    depth = np.zeros(len(points))
    depth[near] = closest_points(points[near], points, ball)[0] * MM_PER_M * (winding(points[near], points[ball]) > 0.5)
    return depth


def teeth_of(data: GNMData) -> list[Int[np.ndarray, "_ 3"]]:
    """The triangles of each tooth."""
    mesh = data.triangles[regions.teeth(data)[data.triangles].all(1)].astype(np.int64)
    ends = np.concatenate([mesh[:, [0, 1]], mesh[:, [1, 2]]]).T
    _, piece = connected_components(coo_matrix((np.ones(ends.shape[1]), ends)), directed=False)
    return [mesh[piece[mesh[:, 0]] == number] for number in np.unique(piece[mesh])]


def tooth_depths_mm(
    points: Float[np.ndarray, "P 3"], vertices: Float[np.ndarray, "V 3"], teeth: list[Int[np.ndarray, "_ 3"]]
) -> Float[np.ndarray, "P"]:
    """How deep points lie in any of some teeth; 0 outside. Roots may be open: for this they are closed by a cone."""
    depth = np.zeros(len(points))
    for tooth in teeth:
        corners = vertices[tooth]
        boxed = np.flatnonzero(((points > corners.min((0, 1))) & (points < corners.max((0, 1)))).all(1))
        if len(boxed):
            inside = winding(points[boxed], np.concatenate([corners, _cone(vertices, tooth)])) > 0.5
            found = closest_points(points[boxed], vertices, tooth)[0] * MM_PER_M
            depth[boxed] = np.maximum(depth[boxed], np.where(inside, found, 0.0))
    return depth


def _cone(vertices: Float[np.ndarray, "V 3"], part: Int[np.ndarray, "_ 3"]) -> Float[np.ndarray, "_ 3 3"]:
    """Triangles that close the opening of a part, bulging a little."""
    ends = {(a, b) for a, b in part[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2).tolist()}
    rim = vertices[np.array([(b, a) for a, b in ends if (b, a) not in ends], int).reshape(-1, 2)]
    if not len(rim):
        return np.empty((0, 3, 3))
    centre = rim.mean((0, 1))
    out = centre - vertices[part].mean((0, 1))
    tip = centre + 0.5 * np.linalg.norm(rim[:, 0] - centre, axis=1).mean() * out / np.linalg.norm(out)
    return np.stack([rim[:, 0], rim[:, 1], np.broadcast_to(tip, (len(rim), 3))], 1)


def winding(points: Float[np.ndarray, "P 3"], corners: Float[np.ndarray, "F 3 3"]) -> Float[np.ndarray, "P"]:
    """Generalised winding numbers by solid angles (van Oosterom and Strackee, 1983)."""
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
