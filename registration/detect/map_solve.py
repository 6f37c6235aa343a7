"""The points of a model's surface that a detector's landmarks mark, from renders, and how far it strays from them.

Every landmark gets the one point, fixed to the mesh, whose projection into all renders is nearest to what the detector
found: robustly, over people, expressions and views together. Candidates are vertices first, then points of a grid on
the faces around the best ones, so that no starting point is needed. Views that see a candidate at a grazing angle count
less. Landmarks of both sides are solved together on a mirror image of the mesh.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float, Int

from registration.capture.triangulation import triangulate
from registration.detect.map_renders import Observations
from registration.geometry.topology import vertex_normals
from registration.model.gnm_npz import GNMData
from registration.model.landmarks import LandmarkScheme
from registration.progress import NullProgress, Progress
from registration.types import Capture, View

UNMATCHED = -1  # in `Observations.opposite`: no landmark on the other side is known
LEAST_SPREAD_M = 5e-4  # of the map alone; the detector's own is in the capture
_HUBER_M = 2e-3  # residuals beyond count linearly
_LEAST_FACING = 0.2  # weight of a view that sees a candidate from the side or from behind
_COARSE_EVERY = 4  # of the views choose the vertices
_KEPT, _BEST = 200, 10  # vertices compared in all views, and those whose faces are searched
_GRID = 6  # steps along the edge of a face


@dataclass(frozen=True, kw_only=True, eq=False)
class Regions:
    """The vertices on which landmarks may lie."""

    skin: Bool[np.ndarray, "V"]
    own: Mapping[int, Bool[np.ndarray, "V"]]  # landmark -> its vertices; all others lie on the skin


def solve(data: GNMData, observations: Observations, areas: Regions, name: str) -> LandmarkScheme:
    """Return the surface points that the landmarks mark, without a spread.

    Args:
        data: the model.
        observations: of its people.
        areas: where landmarks may lie.
        name: of the scheme.
    """
    views = _Views(data, observations)
    mirror = data.mirror_indices.astype(np.int64)
    middle = mirror == np.arange(len(mirror))
    count = observations.pixels.shape[2]
    indices, weights = np.zeros((count, 3), np.int64), np.zeros((count, 3))
    for landmark in range(count):
        other = int(observations.opposite[landmark])
        if UNMATCHED < other < landmark:
            indices[landmark], weights[landmark] = mirror[indices[other]], weights[other]
            continue
        allowed = areas.own.get(landmark, areas.skin)
        if other == landmark and (allowed & middle).any():
            allowed = allowed & middle
        pair = None if other in (UNMATCHED, landmark) else (other, mirror)
        indices[landmark], weights[landmark] = _solve_one(views, data.triangles, landmark, pair, allowed)
    return LandmarkScheme(name=name, indices=indices, weights=weights)


def errors(scheme: LandmarkScheme, observations: Observations) -> Float[np.ndarray, "H L 3"]:
    """Return the landmarks triangulated over each head's views minus the map's points on its mesh, metres.

    NaN where a landmark cannot be triangulated.
    """
    result = []
    for vertices, cameras, pixels in zip(observations.vertices, observations.cameras, observations.pixels, strict=True):
        views = tuple(
            View(name=str(i), camera=camera, image=Path(str(i)), landmarks={scheme.name: _confident(xy)})
            for i, (camera, xy) in enumerate(zip(cameras, pixels, strict=True))
        )
        capture = Capture(root=Path(), subject="", expression="", views=views)
        result.append(triangulate(capture, scheme.name)[0] - scheme.points(vertices.astype(np.float64)))
    return np.stack(result)


def held_out_errors(
    data: GNMData, observations: Observations, areas: Regions, name: str, progress: Progress | None = None
) -> Float[np.ndarray, "H L 3"]:
    """Return `errors` of each head with a map that was solved without the person, in two halves of the people."""
    progress = progress or NullProgress()
    result = np.full((len(observations.person), observations.pixels.shape[2], 3), np.nan)
    for half in range(2):
        held_out = observations.person % 2 == half
        known = solve(data, _select(observations, ~held_out), areas, name)
        result[held_out] = errors(known, _select(observations, held_out))
        progress.update(half + 1, 2, "held-out halves")
    return result


def spread(held_out: Float[np.ndarray, "H L 3"], opposite: Int[np.ndarray, "L"]) -> Float[np.ndarray, "L"]:
    """Return the standard deviation along each axis, metres, of triangulated landmarks around a map's points.

    Over held-out people, expressions and views; it holds what is the same in all of a head's views, too. Landmarks of
    both sides are pooled.

    Args:
        held_out: the errors.
        opposite: landmark of the other side.
    """
    square = np.nanmean((held_out**2).mean(-1), axis=0)
    square = np.where(np.isfinite(square), square, np.nanmax(square))
    other = np.where(opposite == UNMATCHED, np.arange(len(opposite)), opposite)
    return np.maximum(np.sqrt((square + square[other]) / 2), LEAST_SPREAD_M)


def _confident(pixels: Float[np.ndarray, "L 2"]) -> Float[np.ndarray, "L 3"]:
    seen = np.isfinite(pixels).all(1)
    return np.column_stack([np.nan_to_num(pixels), seen])


def _select(observations: Observations, heads: Bool[np.ndarray, "H"]) -> Observations:
    rows = np.flatnonzero(heads)
    return replace(
        observations,
        vertices=observations.vertices[rows],
        cameras=tuple(observations.cameras[i] for i in rows),
        pixels=observations.pixels[rows],
        person=observations.person[rows],
        expression=tuple(observations.expression[i] for i in rows),
    )


class _Views:
    """The N pictures with a face: vertices and landmarks in metres of the plane through the head's centre."""

    def __init__(self, data: GNMData, observations: Observations):
        triangles = torch.as_tensor(data.triangles.astype(np.int64))
        projected, facing, found = [], [], []
        for vertices, cameras, pixels in zip(
            observations.vertices, observations.cameras, observations.pixels, strict=True
        ):
            normals = vertex_normals(torch.as_tensor(vertices), triangles).numpy()
            for camera, points in zip(cameras, pixels, strict=True):
                if not np.isfinite(points).all():
                    continue
                xy, depth = camera.project(vertices.astype(np.float64))
                metres_per_px = np.median(depth) / camera.intrinsics[0, 0]
                towards = camera.centre - vertices
                towards /= np.linalg.norm(towards, axis=1, keepdims=True)
                projected.append((xy * metres_per_px).astype(np.float32))
                found.append((points * metres_per_px).astype(np.float32))
                facing.append(np.clip((normals * towards).sum(1), _LEAST_FACING, 1).astype(np.float32))
        self.projected, self.facing, self.found = np.stack(projected), np.stack(facing), np.stack(found)

    def cost(
        self, landmark: int, indices: Int[np.ndarray, "G 3"], weights: Float[np.ndarray, "G 3"], every: int = 1
    ) -> Float[np.ndarray, "G"]:
        """Return the robust mean distance of candidates, weighted sums of vertices, from a landmark, squared metres."""
        weights = weights.astype(np.float32)
        points = np.einsum("ngkc,gk->ngc", self.projected[::every][:, indices], weights)
        facing = np.einsum("ngk,gk->ng", self.facing[::every][:, indices], weights)
        square = ((points - self.found[::every, landmark][:, None]) ** 2).sum(-1)
        robust = np.sqrt(_HUBER_M**2 + square) - _HUBER_M  # pseudo-Huber
        return np.asarray((facing * robust).sum(0) / facing.sum(0), np.float64)

    def vertex_cost(self, landmark: int, rows: Int[np.ndarray, "G"], every: int = 1) -> Float[np.ndarray, "G"]:
        """Return `cost` of vertices."""
        square = ((self.projected[::every, rows] - self.found[::every, landmark][:, None]) ** 2).sum(-1)
        facing = self.facing[::every, rows]
        robust = np.sqrt(_HUBER_M**2 + square) - _HUBER_M
        return np.asarray((facing * robust).sum(0) / facing.sum(0), np.float64)


def _solve_one(
    views: _Views,
    triangles: Int[np.ndarray, "F 3"],
    landmark: int,
    pair: tuple[int, Int[np.ndarray, "V"]] | None,
    allowed: Bool[np.ndarray, "V"],
) -> tuple[Int[np.ndarray, "3"], Float[np.ndarray, "3"]]:
    """Return the vertices and weights of one landmark, or of one and its counterpart on the mirrored mesh."""

    def of_vertices(rows: np.ndarray, every: int) -> np.ndarray:
        cost = views.vertex_cost(landmark, rows, every)
        return cost if pair is None else cost + views.vertex_cost(pair[0], pair[1][rows], every)

    rows = np.flatnonzero(allowed)
    rows = rows[np.argsort(of_vertices(rows, _COARSE_EVERY))[:_KEPT]]
    rows = rows[np.argsort(of_vertices(rows, 1))[:_BEST]]
    near = np.zeros(len(allowed), bool)
    near[rows] = True
    indices, weights = _grid(triangles, near, allowed)
    cost = views.cost(landmark, indices, weights)
    if pair is not None:
        cost = cost + views.cost(pair[0], pair[1][indices], weights)
    best = int(cost.argmin())
    return indices[best], weights[best]


def _grid(
    triangles: Int[np.ndarray, "F 3"], near: Bool[np.ndarray, "V"], allowed: Bool[np.ndarray, "V"]
) -> tuple[Int[np.ndarray, "G 3"], Float[np.ndarray, "G 3"]]:
    """Return a grid of points on the faces with a near corner, of which the corners with weight are allowed."""
    faces = triangles[near[triangles].any(1)].astype(np.int64)
    i, j = np.meshgrid(np.arange(_GRID + 1), np.arange(_GRID + 1), indexing="ij")
    inside = i + j <= _GRID
    steps = np.stack([i[inside], j[inside], _GRID - i[inside] - j[inside]], 1) / _GRID
    indices = np.repeat(faces, len(steps), 0)
    weights = np.tile(steps, (len(faces), 1))
    kept = (allowed[indices] | (weights == 0)).all(1)
    return indices[kept], weights[kept]
