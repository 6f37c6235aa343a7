"""The gradient of visibility: primary edge sampling (Li et al. 2018) over the silhouettes of all views at once.

An edge is a silhouette of a view if exactly one of its faces looks at the camera, or if it has one face only. Seams
of the texture's charts are sampled like silhouettes: nothing is hidden there, but the colour may jump.
Samples are uniform over the projected length L (px) of all silhouettes of all views; with N samples

    dLoss = (L / N) sum [g(pixel) . (f_in - f_out)] n . [(1 - s) dx_A + s dx_B]

where x_A, x_B are the projected ends (px), n is the outward normal of the edge in the image, s the position on it
(linear on the screen), g the adjoint image, f_in the channels on the edge and f_out those just beyond it.
"""

from __future__ import annotations  # mi.Float exists only once a variant is chosen

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np
from jaxtyping import Float

from registration.geometry.topology import Edges
from registration.render.adjoint import Adjoint
from registration.render.cameras import CameraLanes, PixelList
from registration.render.scene import TriangleScene
from registration.render.shading import Surface

# How far beyond the edge the outside ray goes, in focal lengths (px). Larger biases, smaller meets float32.
_STEP = 1e-6
# An outside hit nearer than the edge by more than this share of its depth hides the edge.
_DEPTH_TOLERANCE = 1e-5
_SEARCH_END = (1 << 22) - 1  # fixed, so that the number of silhouette edges never compiles a new kernel
_SAMPLE_BLOCK = 4096
_NONE = 0xFFFFFFFF


@dataclass(frozen=True, kw_only=True)
class EdgeArrays:
    """`topology.Edges` on the device; a missing second side is _NONE."""

    vertices: mi.UInt32  # 2E
    faces: mi.UInt32  # 2E
    corners: mi.UInt32  # 4E
    seams: mi.Bool  # E
    count: int


def upload(edges: Edges, corner_uvs: Float[np.ndarray, "F 3 2"]) -> EdgeArrays:
    def flat(array: np.ndarray) -> mi.UInt32:
        return mi.UInt32(np.where(array < 0, _NONE, array).astype(np.uint32).ravel())

    uvs = corner_uvs.reshape(-1, 2)
    seams = (edges.faces[:, 1] >= 0) & (uvs[edges.corners[:, 0]] != uvs[edges.corners[:, 1]]).any((1, 2))
    return EdgeArrays(
        vertices=flat(edges.vertices),
        faces=flat(edges.faces),
        corners=flat(edges.corners),
        seams=mi.Bool(seams),
        count=len(edges.vertices),
    )


@dataclass(frozen=True, kw_only=True)
class _Silhouettes:
    """The silhouette edges of all views: which, how they lie in the cumulated length, which side is seen."""

    ids: mi.UInt32  # view * edge count + edge
    side: mi.UInt32  # 0 or 1: the side that is seen
    length_px: mi.Float  # cumulated
    count: mi.UInt32
    total_px: mi.Float


def _find(surface: Surface, edges: EdgeArrays, pixels: PixelList) -> _Silhouettes | None:
    face_count = dr.width(surface.faces) // 3
    faces, edge_count = dr.opaque(mi.UInt32, face_count), dr.opaque(mi.UInt32, edges.count)

    lane = dr.arange(mi.UInt32, pixels.camera_count * face_count)
    view = lane // faces
    corners = surface.corners(lane - view * faces)
    a, b, c = (surface.position(corners[k]) for k in range(3))
    facing = dr.dot(dr.cross(b - a, c - a), pixels.centre(view) - a) > 0
    dr.eval(facing)

    lane = dr.arange(mi.UInt32, pixels.camera_count * edges.count)
    view = lane // edge_count
    edge = lane - view * edge_count
    pair = dr.gather(mi.Point2u, edges.faces, edge)
    boundary = pair.y == _NONE
    first = dr.gather(mi.Bool, facing, view * faces + pair.x)
    second = dr.gather(mi.Bool, facing, view * faces + pair.y, ~boundary)
    jumps = boundary | (first != second)
    if surface.texture is not None:
        jumps |= first & dr.gather(mi.Bool, edges.seams, edge)
    ids = dr.compress(jumps)
    if dr.width(ids) == 0:
        return None
    side = dr.gather(mi.UInt32, dr.select(boundary | first, mi.UInt32(0), 1), ids)

    view = ids // edge_count
    edge = ids - view * edge_count
    side = _nearer(surface, edges, edge, side)
    ends = dr.gather(mi.Point2u, edges.vertices, edge)
    camera = pixels.camera(view)
    xa, za = camera.project(surface.position(ends.x))
    xb, zb = camera.project(surface.position(ends.y))
    length = dr.cumsum(dr.select((za > 0) & (zb > 0), dr.norm(xb - xa), 0))
    count = dr.opaque(mi.UInt32, dr.width(ids))
    total = dr.gather(mi.Float, length, count - 1)
    dr.eval(ids, side, length, total)
    return _Silhouettes(ids=ids, side=side, length_px=length, count=count, total_px=total)


def _nearer(surface: Surface, edges: EdgeArrays, edge: mi.UInt32, facing: mi.UInt32) -> mi.UInt32:
    """The side of each edge that hides the other, given a side that faces the camera.

    Both faces of a silhouette lie on one side of it in the image. On an outer bulge the one that faces the camera is
    nearer; on a fold that is seen from inside an open mesh it is the other, which then lies before the first's plane.
    """
    pair = dr.gather(mi.Point2u, edges.faces, edge)
    other = dr.select(facing == 0, pair.y, pair.x)
    has_other = other != _NONE
    corners = surface.corners(dr.select(facing == 0, pair.x, pair.y))
    a, b, c = (surface.position(corners[k]) for k in range(3))
    corners = surface.corners(other, has_other)
    beside = sum((surface.position(corners[k], has_other) for k in range(3)), mi.Point3f(0)) / 3
    folded = has_other & (dr.dot(dr.cross(b - a, c - a), beside - a) > 0)
    return dr.select(folded, 1 - facing, facing)


def _sample(found: _Silhouettes, samples: int, seed: int) -> tuple[mi.UInt32, mi.Float]:
    """Stratified samples uniform over length: which silhouette, and where on it (screen-linear)."""
    lane = dr.arange(mi.UInt32, samples)
    random, _ = mi.sample_tea_32(lane, dr.opaque(mi.UInt32, seed))
    jitter = mi.Float(random) * (1 / 4294967296)
    position = (mi.Float(lane) + jitter) / dr.opaque(mi.Float, samples) * found.total_px
    last = found.count - 1

    def before(index: mi.Int32 | int) -> mi.Bool:
        index = mi.UInt32(index)
        return (index < last) & (dr.gather(mi.Float, found.length_px, dr.minimum(index, last)) < position)

    which = dr.minimum(dr.binary_search(0, _SEARCH_END, before), last)
    start = dr.select(which > 0, dr.gather(mi.Float, found.length_px, dr.maximum(which, 1) - 1), 0)
    end = dr.gather(mi.Float, found.length_px, which)
    return which, dr.clip((position - start) / dr.maximum(end - start, 1e-12), 0, 1)


def _outward(surface: Surface, camera: CameraLanes, face: mi.UInt32, xa: mi.Point2f, xb: mi.Point2f) -> mi.Vector2f:
    """The unit normal of an edge in the image that points away from its face."""
    along = xb - xa
    along /= dr.maximum(dr.norm(along), 1e-12)
    normal = mi.Vector2f(-along.y, along.x)
    corners = surface.corners(face)
    centre, _ = camera.project(sum((surface.position(corners[k]) for k in range(3)), mi.Point3f(0)) / 3)
    return dr.select(dr.dot(centre - xa, normal) > 0, -normal, normal)


def backward(
    scene: TriangleScene,
    surface: Surface,
    edges: EdgeArrays,
    pixels: PixelList,
    adjoint: Adjoint,
    *,
    samples_per_px: float,
    seed: int,
) -> list[tuple[mi.UInt32, mi.Point3f]]:
    """The silhouettes' part of d(adjoint . image)/d(positions), as terms: (vertex, gradient) per lane."""
    with dr.suspend_grad():
        found = _find(surface, edges, pixels)
        if found is None:
            return []
        samples = int(samples_per_px * float(dr.slice(found.total_px, 0)))
        samples = _SAMPLE_BLOCK * (1 + samples // _SAMPLE_BLOCK)  # few distinct sizes: memory is reused
        which, s = _sample(found, samples, seed)
        view_edge, side = dr.gather(mi.UInt32, found.ids, which), dr.gather(mi.UInt32, found.side, which)
        edge_count = dr.opaque(mi.UInt32, edges.count)
        view = view_edge // edge_count
        edge = view_edge - view * edge_count
        ends = dr.gather(mi.Point2u, edges.vertices, edge)
        camera = pixels.camera(view)
        xa, za = camera.project(surface.position(ends.x))
        xb, zb = camera.project(surface.position(ends.y))
        own = dr.gather(mi.UInt32, edges.faces, 2 * edge + side)
        normal = _outward(surface, camera, own, xa, xb)

        x = dr.lerp(xa, xb, s)
        depth = dr.rcp((1 - s) / za + s / zb)
        pixel, inside = pixels.at(view, x, (za > 0) & (zb > 0))
        beyond = x + normal * (_STEP * camera.fx)
        direction = camera.direction(beyond.x, beyond.y)
        hit = scene.cast(camera.centre, direction, inside, coherent=False)
        is_hit = inside & hit.is_valid()
        seen = inside & ~(is_hit & (hit.t < depth * (1 - _DEPTH_TOLERANCE)))
        face = dr.select(is_hit, hit.prim_index, 0)
        f_out = surface.shade(surface.load(face, is_hit & seen), hit.prim_uv.x, hit.prim_uv.y, direction, is_hit & seen)
        corners = dr.gather(mi.Point2u, edges.corners, 2 * edge + side, seen)
        perspective = s * za / dr.maximum((1 - s) * zb + s * za, 1e-9)
        f_in = surface.shade_edge(own, ends, corners, perspective, direction, seen)
        jump = adjoint.times([inner - outer for inner, outer in zip(f_in, f_out, strict=True)], pixel, inside)
        weight = dr.select(seen, jump, 0) * (found.total_px / dr.opaque(mi.Float, samples))

    a, b = (dr.gather(mi.Point3f, surface.positions, end, seen) for end in (ends.x, ends.y))
    dr.enable_grad(a, b)
    speed = dr.lerp(dr.dot(normal, camera.project(a)[0]), dr.dot(normal, camera.project(b)[0]), s)
    dr.backward(dr.select(seen, weight * speed, 0))
    return [(ends.x, dr.grad(a)), (ends.y, dr.grad(b))]
