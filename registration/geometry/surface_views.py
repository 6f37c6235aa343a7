"""Normals and depths of a raw surface, such as a scan, as pinhole cameras see it, and how far they can be trusted.

For the targets of a fit, where the surface stands for normals that were never photographed. A raw surface has holes,
ragged borders, pieces behind one another and noise: pixels near any of these get no weight.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy.sparse import coo_array, diags_array
from scipy.spatial import cKDTree

from registration.geometry.rasterizer import RayCaster
from registration.geometry.topology import boundary_vertices, vertex_normals
from registration.types import Camera

_LEAST_COSINE = 0.25  # of incidence: 75 degrees; beyond it a pixel sees much surface, and a calibration error moves it
_STEP_M, _STEP_PX = 3e-3, 4.0  # depth between neighbouring pixels that separates two surfaces: the larger of both
_MAX_ROUNDS = 60  # of smoothing
_ROUND = 3 / 7  # squared edge lengths by which one round of averaging six neighbours widens a normal, along each axis
_VOTE_PX = 96  # size of the pictures that decide which side of the surface is its outside


@dataclass(frozen=True, kw_only=True, eq=False)
class SurfaceView:
    """What one camera sees of a surface at the centre of each pixel."""

    depth: Float[np.ndarray, "H W"]  # along the optical axis, metres; inf where there is no surface
    normals: Float[np.ndarray, "H W 3"]  # world, unit, of the outside; 0 where there is no surface
    weight: Float[np.ndarray, "H W"]  # cosine of incidence; 0 where the normal cannot be trusted
    face: Int[np.ndarray, "H W"]  # -1 where there is no surface
    barycentric: Float[np.ndarray, "H W 3"]  # of the surface point in its face


class SurfaceViews:
    """A triangle mesh prepared for views from several cameras; world frame, metres.

    Its faces may be wound inwards: the side that the cameras see more of is the outside.
    """

    def __init__(
        self,
        vertices: Float[np.ndarray, "V 3"],
        triangles: Int[np.ndarray, "F 3"],
        cameras: Sequence[Camera],
        *,
        foreign: Bool[np.ndarray, "V"] | None = None,
        smoothing_m: float = 5e-4,
        boundary_m: float = 2e-3,
    ):
        """Build the tree and the vertices' normals.

        Args:
            vertices: finite.
            triangles: vertex indices, at least one.
            cameras: those that tell outside from inside.
            foreign: vertices that are not trusted, though they hide others.
            smoothing_m: standard deviation over which normals are averaged along the surface; no effect where edges are
                longer.
            boundary_m: distance from the surface's borders, also those of holes, within which nothing is trusted.
        """
        self.vertices: Float[np.ndarray, "V 3"] = np.asarray(vertices, np.float64)
        self.triangles: Int[np.ndarray, "F 3"] = np.ascontiguousarray(triangles, np.int64)
        self._caster = RayCaster(self.vertices, self.triangles)
        faces = torch.from_numpy(self.triangles)
        centred = self.vertices - self.vertices.mean(0)
        normals = _smoothed(
            vertex_normals(torch.from_numpy(centred), faces).numpy(), centred, self.triangles, smoothing_m
        )
        a, b, c = (centred[self.triangles[:, k]] for k in range(3))
        self._plane = np.cross(b - a, c - a)  # of each face, twice its area long
        if self._seen_from_inside(cameras):
            normals, self._plane = -normals, -self._plane
        self.normals: Float[np.ndarray, "V 3"] = normals
        border = _near_border(self.vertices, self.triangles, boundary_m)
        border |= False if foreign is None else foreign
        self.at_border = np.asarray(border[self.triangles].any(1))  # (F,)

    def view(self, camera: Camera) -> SurfaceView:
        """Render depth, normals and weights for one camera.

        Args:
            camera: a pinhole; its distortion is ignored.
        """
        face, barycentric = self._caster.rasterize(camera)
        hit = face >= 0
        corners, share = self.triangles[face[hit]], barycentric[hit]
        point = np.einsum("pk,pkc->pc", share, self.vertices[corners])
        normal = np.einsum("pk,pkc->pc", share, self.normals[corners])
        normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-20)
        towards = camera.centre - point
        towards /= np.linalg.norm(towards, axis=1, keepdims=True)
        cosine = (normal * towards).sum(1)
        facing = np.einsum("pc,pc->p", self._plane[face[hit]], towards)
        trusted = (cosine > _LEAST_COSINE) & (facing > 0) & ~self.at_border[face[hit]]
        depth, normals, weight = np.full(face.shape, np.inf), np.zeros((*face.shape, 3)), np.zeros(face.shape)
        depth[hit] = point @ camera.T_cam_world[2, :3] + camera.T_cam_world[2, 3]
        normals[hit], weight[hit] = normal, np.where(trusted, cosine, 0)
        weight[_at_step(depth, camera)] = 0
        return SurfaceView(depth=depth, normals=normals, weight=weight, face=face, barycentric=barycentric)

    def _seen_from_inside(self, cameras: Sequence[Camera]) -> bool:
        """Whether the cameras see the faces' backs more than their fronts."""
        balance = 0
        for camera in cameras:
            size = max(camera.width_px, camera.height_px)
            small = camera.scaled(*(max(1, side * _VOTE_PX // size) for side in (camera.width_px, camera.height_px)))
            face = self._caster.rasterize(small)[0]
            seen = face[face >= 0]
            towards = camera.centre - self.vertices[self.triangles[seen, 0]]
            balance += int(np.sign((self._plane[seen] * towards).sum(1)).sum())
        return balance < 0


def _smoothed(
    normals: Float[np.ndarray, "V 3"],
    vertices: Float[np.ndarray, "V 3"],
    triangles: Int[np.ndarray, "F 3"],
    width: float,
) -> Float[np.ndarray, "V 3"]:
    """Average unit normals over neighbours until the standard deviation of the window is `width`, metres."""
    start, end = triangles.ravel(), np.roll(triangles, -1, 1).ravel()
    length = float(np.sqrt(((vertices[start] - vertices[end]) ** 2).sum(1).mean()))
    rounds = min(_MAX_ROUNDS, round((width / length) ** 2 / _ROUND)) if length > 0 else 0
    if not rounds:
        return normals
    count, ones = len(vertices), np.ones(2 * len(start))
    linked = coo_array((ones, (np.r_[start, end], np.r_[end, start])), shape=(count, count)).tocsr()
    linked.data[:] = 1  # an edge between two faces was counted twice
    linked = (linked + diags_array(np.ones(count))).tocsr()
    for _ in range(rounds):
        normals = linked @ normals
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-20)
    return normals


def _near_border(
    vertices: Float[np.ndarray, "V 3"], triangles: Int[np.ndarray, "F 3"], distance: float
) -> Bool[np.ndarray, "V"]:
    near = boundary_vertices(triangles, len(vertices))
    if near.any():
        near |= cKDTree(vertices[near]).query(vertices, distance_upper_bound=distance)[0] <= distance
    return near


def _at_step(depth: Float[np.ndarray, "H W"], camera: Camera) -> Bool[np.ndarray, "H W"]:
    """Pixels with a neighbour at another depth, or without a surface; not those at the image's border."""
    finite = np.where(np.isfinite(depth), depth, 1e6)
    nearest, farthest = (change(finite, np.ones((3, 3), np.uint8)) for change in (cv2.erode, cv2.dilate))
    return farthest - nearest > np.maximum(_STEP_M, _STEP_PX * 2 * nearest / camera.intrinsics[0, 0])
