"""The gradient of visibility: primary edge sampling (Li et al. 2018) over the silhouettes of all views at once.

An edge is a silhouette of a view if exactly one of its faces looks at the camera, or if it has one face only. Seams
of the texture's charts are sampled like silhouettes where their outer side is seen: nothing is hidden there, but the
colour may jump.
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
from registration.render.adjoint import Adjoint, RowSum
from registration.render.cameras import CameraLanes, PixelList
from registration.render.scene import TriangleScene
from registration.render.shading import NO_FACE, Drawn, Surface

# How far beyond the edge the outside ray goes, in focal lengths (px). Larger biases, smaller meets float32.
_STEP = 1e-6
# An outside hit nearer than the edge by more than this share of its depth hides the edge.
_DEPTH_TOLERANCE = 1e-5
# A sample this far behind all that the pixels around it show, in metres, is hidden. Thinner gaps than a pixel are lost.
_FAR = 2e-3
_SEARCH_END = (1 << 22) - 1  # fixed, so that the number of silhouette edges never compiles a new kernel
_SAMPLE_BLOCK = 4096


@dataclass(frozen=True, kw_only=True)
class EdgeArrays:
    """`topology.Edges` on the device; a missing second side is NO_FACE."""

    vertices: mi.UInt32  # 2E
    faces: mi.UInt32  # 2E
    corners: mi.UInt32  # 4E
    seams: mi.Bool  # E
    count: int


def upload(edges: Edges, corner_uvs: Float[np.ndarray, "F 3 2"]) -> EdgeArrays:
    def flat(array: np.ndarray) -> mi.UInt32:
        return mi.UInt32(np.where(array < 0, NO_FACE, array).astype(np.uint32).ravel())

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
    """The silhouette edges of all views: which, how they lie in the images and in the cumulated length."""

    ids: mi.UInt32  # view * edge count + edge
    side: mi.UInt32  # 0 or 1: the side that is seen
    rows: mi.Float  # (M, 8): x and y of both ends (px), depth of both (m), outward normal
    length_px: mi.Float  # cumulated
    count: mi.UInt32
    total_px: mi.Float


def facing(surface: Surface, pixels: PixelList) -> mi.Bool:
    """Whether a view sees the outer side of a face, for all views' faces (N F)."""
    face_count = dr.opaque(mi.UInt32, surface.face_count)
    lane = dr.arange(mi.UInt32, pixels.camera_count * surface.face_count)
    view = lane // face_count
    normal, offset = surface.plane(lane - view * face_count)
    return dr.dot(normal, pixels.centre(view)) > offset


def _find(surface: Surface, edges: EdgeArrays, pixels: PixelList, facing: mi.Bool) -> _Silhouettes | None:
    faces, edge_count = dr.opaque(mi.UInt32, surface.face_count), dr.opaque(mi.UInt32, edges.count)
    lane = dr.arange(mi.UInt32, pixels.camera_count * edges.count)
    view = lane // edge_count
    edge = lane - view * edge_count
    pair = dr.gather(mi.Point2u, edges.faces, edge)
    boundary = pair.y == NO_FACE
    first = dr.gather(mi.Bool, facing, view * faces + pair.x)
    second = dr.gather(mi.Bool, facing, view * faces + pair.y, ~boundary)
    jumps = boundary | (first != second)
    if surface.texture is not None:
        jumps |= first & dr.gather(mi.Bool, edges.seams, edge)
    ids = dr.compress(jumps)
    if dr.width(ids) == 0:
        return None
    view = ids // edge_count
    edge = ids - view * edge_count
    pair = dr.gather(mi.Point2u, edges.faces, edge)
    first = (pair.y == NO_FACE) | dr.gather(mi.Bool, facing, view * faces + pair.x)
    side = _nearer(surface, pair, dr.select(first, mi.UInt32(0), 1))
    ends = dr.gather(mi.Point2u, edges.vertices, edge)
    camera = pixels.camera(view)
    xa, za = camera.project(surface.position(ends.x))
    xb, zb = camera.project(surface.position(ends.y))
    normal = _outward(surface, camera, dr.select(side == 0, pair.x, pair.y), xa, xb)
    length = dr.cumsum(dr.select((za > 0) & (zb > 0), dr.norm(xb - xa), 0))
    count = dr.opaque(mi.UInt32, dr.width(ids))
    total = dr.gather(mi.Float, length, count - 1)
    rows = dr.ravel(mi.ArrayXf([*xa, *xb, za, zb, *normal]))
    dr.eval(ids, side, rows, length, total)
    return _Silhouettes(ids=ids, side=side, rows=rows, length_px=length, count=count, total_px=total)


def _nearer(surface: Surface, pair: mi.Point2u, facing: mi.UInt32) -> mi.UInt32:
    """Which of an edge's two faces hides the other, given one that faces the camera.

    Both faces of a silhouette lie on one side of it in the image. On an outer bulge the one that faces the camera is
    nearer; on a fold that is seen from inside an open mesh it is the other, which then lies before the first's plane.
    """
    own, other = (dr.select(facing == side, pair.x, pair.y) for side in (0, 1))
    has_other = other != NO_FACE
    normal, offset = surface.plane(own)
    folded = has_other & (dr.dot(normal, _centre(surface, other, has_other)) > offset)
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
    centre, _ = camera.project(_centre(surface, face))
    return dr.select(dr.dot(centre - xa, normal) > 0, -normal, normal)


def _centre(surface: Surface, face: mi.UInt32, active: mi.Bool | bool = True) -> mi.Point3f:
    a, b, c = (surface.position(vertex, active) for vertex in surface.corners(face, active))
    return (a + b + c) / 3


class _Samples:
    """Points on silhouettes, where they lie in their images, and what lies there."""

    def __init__(self, found: _Silhouettes, which: mi.UInt32, s: mi.Float):
        self.found, self.which, self.s = found, which, s
        first, second = (dr.gather(mi.Vector4f, found.rows, 2 * which + k) for k in range(2))
        self.za, self.zb = second.x, second.y
        self.normal = mi.Vector2f(second.z, second.w)  # outward
        self.x = mi.Point2f(dr.lerp(first.x, first.z, s), dr.lerp(first.y, first.w, s))
        self.depth = dr.rcp((1 - s) / self.za + s / self.zb)
        self.in_front = (self.za > 0) & (self.zb > 0)

    def take(self, lanes: mi.UInt32) -> _Samples:
        return _Samples(self.found, dr.gather(mi.UInt32, self.which, lanes), dr.gather(mi.Float, self.s, lanes))

    def edge(self, edges: EdgeArrays) -> tuple[mi.UInt32, mi.UInt32]:
        """View and edge."""
        ids = dr.gather(mi.UInt32, self.found.ids, self.which)
        count = dr.opaque(mi.UInt32, edges.count)
        view = ids // count
        return view, ids - view * count


def _far_behind(samples: _Samples, view: mi.UInt32, pixels: PixelList, depth: mi.Float, listed: mi.Bool) -> mi.Bool:
    """Whether the four pixel centres around a point all show something far before it."""
    hidden = mi.Bool(True)
    for dx in (-0.5, 0.5):
        for dy in (-0.5, 0.5):
            pixel, known = pixels.at(view, samples.x + mi.Vector2f(dx, dy), listed)
            hidden &= known & (dr.gather(mi.Float, depth, pixel, known) < samples.depth - _FAR)
    return hidden


def backward(
    scene: TriangleScene,
    drawn: Drawn,
    edges: EdgeArrays,
    adjoint: Adjoint,
    vertices: RowSum,
    *,
    samples_per_px: float,
    seed: int,
) -> None:
    """Add the silhouettes' part of d(adjoint . image) to the gradient of positions."""
    surface, pixels = drawn.surface, drawn.pixels
    found = _find(surface, edges, pixels, drawn.facing)
    if found is None:
        return
    count = int(samples_per_px * float(dr.slice(found.total_px, 0)))
    count = _SAMPLE_BLOCK * (1 + count // _SAMPLE_BLOCK)  # few distinct sizes: memory is reused
    samples = _Samples(found, *_sample(found, count, seed))
    # Most silhouettes lie deep inside the head: they need no ray.
    view, _ = samples.edge(edges)
    _, listed = pixels.at(view, samples.x, samples.in_front)
    kept = listed & ~_far_behind(samples, view, pixels, drawn.deepest, listed)
    dr.eval(samples.which, samples.s, kept)
    kept = dr.compress(kept)
    if dr.width(kept) == 0:
        return
    samples = samples.take(kept)
    hit, seen = _beyond(scene, samples, pixels.camera(samples.edge(edges)[0]))
    met = (dr.select(hit.is_valid(), hit.prim_index, NO_FACE), hit.prim_uv.x, hit.prim_uv.y)
    dr.eval(samples.which, samples.s, met, seen)
    seen = dr.compress(seen)
    if dr.width(seen) == 0:
        return
    face, b1, b2 = (dr.gather(type(values), values, seen) for values in met)
    samples = samples.take(seen)
    view, edge = samples.edge(edges)
    pixel, _ = pixels.at(view, samples.x, samples.in_front)
    f_in, f_out = _on(samples, drawn, edges, view, edge), _off(drawn, view, face, [1 - b1 - b2, b1, b2])
    jump = adjoint.times([inner - outer for inner, outer in zip(f_in, f_out, strict=True)], pixel)
    weight = jump * (found.total_px / dr.opaque(mi.Float, count))
    camera = pixels.camera(view)
    ends = dr.gather(mi.Point2u, edges.vertices, edge)
    for end, share in ((ends.x, 1 - samples.s), (ends.y, samples.s)):
        vertices.add(end, weight * share * camera.speed(surface.position(end), samples.normal))
    dr.eval(vertices.total)


def _beyond(
    scene: TriangleScene, samples: _Samples, camera: CameraLanes
) -> tuple[mi.PreliminaryIntersection3f, mi.Bool]:
    """What the rays just outside the edges meet, and whether the edges are seen."""
    x = samples.x + samples.normal * (_STEP * camera.fx)
    hit = scene.cast_rays(camera.centre, camera.direction(x.x, x.y), mi.Bool(True), coherent=False)
    return hit, ~(hit.is_valid() & (hit.t < samples.depth * (1 - _DEPTH_TOLERANCE)))


def _on(samples: _Samples, drawn: Drawn, edges: EdgeArrays, view: mi.UInt32, edge: mi.UInt32) -> list[mi.Float]:
    """The channels on the edge, of the side that is seen."""
    side = 2 * edge + dr.gather(mi.UInt32, samples.found.side, samples.which)
    ends, corners = dr.gather(mi.Point2u, edges.vertices, edge), dr.gather(mi.Point2u, edges.corners, side)
    s, za, zb = samples.s, samples.za, samples.zb
    share = s * za / dr.maximum((1 - s) * zb + s * za, 1e-9)  # linear in space
    shares = [1 - share, share]
    colour, _ = drawn.surface.colour(shares, [drawn.surface.corner_uv(corner) for corner in corners])
    return drawn.surface.shade(
        shares, list(ends), colour, drawn.sees_outside(view, dr.gather(mi.UInt32, edges.faces, side))
    )


def _off(drawn: Drawn, view: mi.UInt32, face: mi.UInt32, shares: list[mi.Float]) -> list[mi.Float]:
    """The channels just beyond: of a face, or zeros of the background."""
    is_hit = face != NO_FACE
    channels = drawn.channels(view, dr.select(is_hit, face, 0), shares)
    return [dr.select(is_hit, value, 0) for value in channels]
