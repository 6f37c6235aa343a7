"""The gradient of visibility: primary edge sampling [Li 2018] over the silhouettes of all views at once.

An edge is a silhouette in a view if exactly one of its faces faces the camera, or if it has only one face. Seams of the
texture's charts are sampled like silhouettes where their outer side is visible: nothing is occluded there, but the
colour may be discontinuous. Samples are uniform over the projected length L (px) of all silhouettes of all views; with
N samples

    dLoss = (L / N) sum [g(pixel) . (f_in - f_out)] n . [(1 - s) dx_A + s dx_B]

where x_A, x_B are the projected ends (px), n is the outward normal of the edge in the image, s the position on it
(linear in the image), g the adjoint image, f_in the channels on the edge and f_out those just outside it.
"""

from __future__ import annotations  # mi.Float exists only after a variant is set

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np
from jaxtyping import Float

from registration.geometry.topology import Edges
from registration.render.adjoint import Adjoint, RowSum
from registration.render.cameras import CameraLanes, PixelList
from registration.render.scene import TriangleScene
from registration.render.shading import NO_FACE, ForwardState, RenderMesh

# Distance of the outside ray from the edge, in focal lengths (px): larger values bias, smaller ones are below float32.
_STEP = 1e-6
# An outside hit nearer than the edge by more than this fraction of its depth occludes the edge.
_DEPTH_TOLERANCE = 1e-5
# A sample this far (m) behind everything visible in the pixels around it is occluded; gaps thinner than a pixel are
# lost.
_OCCLUSION_DISTANCE = 2e-3
_SEARCH_END = (1 << 22) - 1  # constant, so that one kernel serves any number of silhouette edges
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
    """Copy edges to the device and mark those whose faces have different uvs: seams of the texture."""

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
    """The M silhouette edges of all views: numbers, projections and cumulative length."""

    ids: mi.UInt32  # view * edge count + edge
    side: mi.UInt32  # 0 or 1: the visible side
    rows: mi.Float  # (M, 8): x and y of both ends (px), depth of both (m), outward normal
    length_px: mi.Float  # cumulative
    count: mi.UInt32
    total_px: mi.Float


def facing(mesh: RenderMesh, pixels: PixelList) -> mi.Bool:
    """Return whether the outer side of a face faces the camera, for all views' faces (N F)."""
    face_count = dr.opaque(mi.UInt32, mesh.face_count)
    lane = dr.arange(mi.UInt32, pixels.camera_count * mesh.face_count)
    view = lane // face_count
    normal, offset = mesh.plane(lane - view * face_count)
    return dr.dot(normal, pixels.centre(view)) > offset


def _find_silhouettes(mesh: RenderMesh, edges: EdgeArrays, pixels: PixelList, facing: mi.Bool) -> _Silhouettes | None:
    """Collect the silhouette edges of all views; None if there are none."""
    faces, edge_count = dr.opaque(mi.UInt32, mesh.face_count), dr.opaque(mi.UInt32, edges.count)
    lane = dr.arange(mi.UInt32, pixels.camera_count * edges.count)
    view = lane // edge_count
    edge = lane - view * edge_count
    pair = dr.gather(mi.Point2u, edges.faces, edge)
    boundary = pair.y == NO_FACE
    first = dr.gather(mi.Bool, facing, view * faces + pair.x)
    second = dr.gather(mi.Bool, facing, view * faces + pair.y, ~boundary)
    is_silhouette = boundary | (first != second)
    if mesh.texture is not None:
        is_silhouette |= first & dr.gather(mi.Bool, edges.seams, edge)
    ids = dr.compress(is_silhouette)
    if dr.width(ids) == 0:
        return None
    view = ids // edge_count
    edge = ids - view * edge_count
    pair = dr.gather(mi.Point2u, edges.faces, edge)
    first = (pair.y == NO_FACE) | dr.gather(mi.Bool, facing, view * faces + pair.x)
    side = _nearer(mesh, pair, dr.select(first, mi.UInt32(0), 1))
    ends = dr.gather(mi.Point2u, edges.vertices, edge)
    camera = pixels.camera(view)
    xa, za = camera.project(mesh.position(ends.x))
    xb, zb = camera.project(mesh.position(ends.y))
    normal = _outward(mesh, camera, dr.select(side == 0, pair.x, pair.y), xa, xb)
    length = dr.cumsum(dr.select((za > 0) & (zb > 0), dr.norm(xb - xa), 0))
    count = dr.opaque(mi.UInt32, dr.width(ids))
    total = dr.gather(mi.Float, length, count - 1)
    rows = dr.ravel(mi.ArrayXf([*xa, *xb, za, zb, *normal]))
    dr.eval(ids, side, rows, length, total)
    return _Silhouettes(ids=ids, side=side, rows=rows, length_px=length, count=count, total_px=total)


def _nearer(mesh: RenderMesh, pair: mi.Point2u, facing: mi.UInt32) -> mi.UInt32:
    """Return which of an edge's two faces occludes the other, given one that faces the camera.

    Both faces of a silhouette are on one side of it in the image. On a convex edge the one that faces the camera is
    nearer; on a fold seen from inside an open mesh it is the other, which is then in front of the first one's plane.
    """
    near, other = (dr.select(facing == side, pair.x, pair.y) for side in (0, 1))
    has_other = other != NO_FACE
    normal, offset = mesh.plane(near)
    folded = has_other & (dr.dot(normal, _centre(mesh, other, has_other)) > offset)
    return dr.select(folded, 1 - facing, facing)


def _sample(silhouettes: _Silhouettes, samples: int, seed: int) -> tuple[mi.UInt32, mi.Float]:
    """Return stratified samples, uniform over length: silhouettes, and positions on them (linear in the image)."""
    lane = dr.arange(mi.UInt32, samples)
    random, _ = mi.sample_tea_32(lane, dr.opaque(mi.UInt32, seed))
    jitter = mi.Float(random) * (1 / 4294967296)
    position = (mi.Float(lane) + jitter) / dr.opaque(mi.Float, samples) * silhouettes.total_px
    last = silhouettes.count - 1

    def before(index: mi.Int32 | int) -> mi.Bool:
        index = mi.UInt32(index)
        return (index < last) & (dr.gather(mi.Float, silhouettes.length_px, dr.minimum(index, last)) < position)

    which = dr.minimum(dr.binary_search(0, _SEARCH_END, before), last)
    start = dr.select(which > 0, dr.gather(mi.Float, silhouettes.length_px, dr.maximum(which, 1) - 1), 0)
    end = dr.gather(mi.Float, silhouettes.length_px, which)
    return which, dr.clip((position - start) / dr.maximum(end - start, 1e-12), 0, 1)


def _outward(mesh: RenderMesh, camera: CameraLanes, face: mi.UInt32, xa: mi.Point2f, xb: mi.Point2f) -> mi.Vector2f:
    """Return the unit normal of an edge in the image that points away from its face."""
    along = xb - xa
    along /= dr.maximum(dr.norm(along), 1e-12)
    normal = mi.Vector2f(-along.y, along.x)
    centre, _ = camera.project(_centre(mesh, face))
    return dr.select(dr.dot(centre - xa, normal) > 0, -normal, normal)


def _centre(mesh: RenderMesh, face: mi.UInt32, active: mi.Bool | bool = True) -> mi.Point3f:
    """Return the centroids of faces."""
    a, b, c = (mesh.position(vertex, active) for vertex in mesh.corners(face, active))
    return (a + b + c) / 3


class _SilhouetteSamples:
    """Points on silhouettes with their image positions (px), outward normals and depths (m)."""

    def __init__(self, silhouettes: _Silhouettes, which: mi.UInt32, s: mi.Float):
        self.silhouettes, self.which, self.s = silhouettes, which, s
        first, second = (dr.gather(mi.Vector4f, silhouettes.rows, 2 * which + k) for k in range(2))
        self.za, self.zb = second.x, second.y
        self.normal = mi.Vector2f(second.z, second.w)  # outward
        self.x = mi.Point2f(dr.lerp(first.x, first.z, s), dr.lerp(first.y, first.w, s))
        self.depth = dr.rcp((1 - s) / self.za + s / self.zb)
        self.in_front = (self.za > 0) & (self.zb > 0)

    def select(self, lanes: mi.UInt32) -> _SilhouetteSamples:
        """Return some of the samples."""
        return _SilhouetteSamples(
            self.silhouettes, dr.gather(mi.UInt32, self.which, lanes), dr.gather(mi.Float, self.s, lanes)
        )

    def edge(self, edges: EdgeArrays) -> tuple[mi.UInt32, mi.UInt32]:
        """Return views and edges."""
        ids = dr.gather(mi.UInt32, self.silhouettes.ids, self.which)
        count = dr.opaque(mi.UInt32, edges.count)
        view = ids // count
        return view, ids - view * count


def _is_occluded(
    samples: _SilhouetteSamples, view: mi.UInt32, pixels: PixelList, depth: mi.Float, listed: mi.Bool
) -> mi.Bool:
    """Return whether the four pixel centres around each sample all show something well in front of it."""
    occluded = mi.Bool(True)
    for dx in (-0.5, 0.5):
        for dy in (-0.5, 0.5):
            pixel, in_list = pixels.lookup(view, samples.x + mi.Vector2f(dx, dy), listed)
            occluded &= in_list & (dr.gather(mi.Float, depth, pixel, in_list) < samples.depth - _OCCLUSION_DISTANCE)
    return occluded


def backward(
    scene: TriangleScene,
    state: ForwardState,
    edges: EdgeArrays,
    adjoint: Adjoint,
    vertices: RowSum,
    *,
    samples_per_px: float,
    seed: int,
) -> None:
    """Add the silhouettes' part of d(adjoint . image).

    Args:
        scene: the mesh for ray casting.
        state: of the forward rendering.
        edges: of the mesh.
        adjoint: of the image.
        vertices: gradients of positions (columns 0 to 2).
        samples_per_px: per pixel of projected silhouette length.
        seed: of the samples.
    """
    mesh, pixels = state.mesh, state.pixels
    silhouettes = _find_silhouettes(mesh, edges, pixels, state.facing)
    if silhouettes is None:
        return
    count = int(samples_per_px * float(dr.slice(silhouettes.total_px, 0)))
    count = _SAMPLE_BLOCK * (1 + count // _SAMPLE_BLOCK)  # few distinct sizes, so that memory is reused
    samples = _SilhouetteSamples(silhouettes, *_sample(silhouettes, count, seed))
    # Most silhouettes are deep inside the head and need no ray.
    view, _ = samples.edge(edges)
    _, listed = pixels.lookup(view, samples.x, samples.in_front)
    kept = listed & ~_is_occluded(samples, view, pixels, state.max_depth, listed)
    dr.eval(samples.which, samples.s, kept)
    kept = dr.compress(kept)
    if dr.width(kept) == 0:
        return
    samples = samples.select(kept)
    hit, visible = _cast_outside(scene, samples, pixels.camera(samples.edge(edges)[0]))
    outside = (dr.select(hit.is_valid(), hit.prim_index, NO_FACE), hit.prim_uv.x, hit.prim_uv.y)
    dr.eval(samples.which, samples.s, outside, visible)
    visible = dr.compress(visible)
    if dr.width(visible) == 0:
        return
    face, b1, b2 = (dr.gather(type(values), values, visible) for values in outside)
    samples = samples.select(visible)
    view, edge = samples.edge(edges)
    pixel, _ = pixels.lookup(view, samples.x, samples.in_front)
    f_in = _channels_on_edge(samples, state, edges, view, edge)
    f_out = _channels_outside(state, view, face, [1 - b1 - b2, b1, b2])
    jump = adjoint.dot([inner - outer for inner, outer in zip(f_in, f_out, strict=True)], pixel)
    weight = jump * (silhouettes.total_px / dr.opaque(mi.Float, count))
    camera = pixels.camera(view)
    ends = dr.gather(mi.Point2u, edges.vertices, edge)
    for end, s in ((ends.x, 1 - samples.s), (ends.y, samples.s)):
        vertices.add(end, weight * s * camera.projection_gradient(mesh.position(end), samples.normal))
    dr.eval(vertices.total)


def _cast_outside(
    scene: TriangleScene, samples: _SilhouetteSamples, camera: CameraLanes
) -> tuple[mi.PreliminaryIntersection3f, mi.Bool]:
    """Return the hits of rays just outside the edges, and whether the edges are visible."""
    x = samples.x + samples.normal * (_STEP * camera.fx)
    hit = scene.cast_rays(camera.centre, camera.direction(x.x, x.y), mi.Bool(True), coherent=False)
    return hit, ~(hit.is_valid() & (hit.t < samples.depth * (1 - _DEPTH_TOLERANCE)))


def _channels_on_edge(
    samples: _SilhouetteSamples, state: ForwardState, edges: EdgeArrays, view: mi.UInt32, edge: mi.UInt32
) -> list[mi.Float]:
    """Return the channels on the edge, of its visible side."""
    side = 2 * edge + dr.gather(mi.UInt32, samples.silhouettes.side, samples.which)
    ends, corners = dr.gather(mi.Point2u, edges.vertices, edge), dr.gather(mi.Point2u, edges.corners, side)
    s, za, zb = samples.s, samples.za, samples.zb
    t = s * za / dr.maximum((1 - s) * zb + s * za, 1e-9)  # position on the edge, linear in space
    weights = [1 - t, t]
    colour, _ = state.mesh.colour(weights, [state.mesh.corner_uv(corner) for corner in corners])
    return state.mesh.shade(
        weights, list(ends), colour, state.faces_camera(view, dr.gather(mi.UInt32, edges.faces, side))
    )


def _channels_outside(
    state: ForwardState, view: mi.UInt32, face: mi.UInt32, barycentric: list[mi.Float]
) -> list[mi.Float]:
    """Return the channels just outside the edge: of a face, or zeros for the background."""
    is_hit = face != NO_FACE
    channels = state.channels(view, dr.select(is_hit, face, 0), barycentric)
    return [dr.select(is_hit, value, 0) for value in channels]
