"""The gradient of the curves in which parts of the mesh intersect: lids and eyeballs, gums and teeth, lips.

Such a curve is a discontinuity of the image like a silhouette, but not an edge of the mesh. It is located between the
centres of neighbouring pixels that see different parts: bisection with a few rays gives faces f and h close to either
side of the change. 1 / depth of a face's plane is linear along the line between the centres, so that the planes
intersect at

    s = D_1 / (D_1 - D_2),   D = 1 / depth_f - 1 / depth_h

with D_1 at the first centre and D_2 at the second. If the change is there and f is nearer before it, the parts
intersect; otherwise one occludes the other, which `silhouette.py` handles. A curve steeper than 45 degrees in the image
is sampled where it crosses rows, any other where it crosses columns: each point stands for one pixel of the curve's
extent, and with the adjoint g of the pixel that contains it

    dLoss = g . (value_f - value_h) ds,   ds = dD / (D_1 - D_2),
    dD = (sum_j b_hj <n_h, dx_hj> / <n_h, d> - sum_j b_fj <n_f, dx_fj> / <n_f, d>) / depth^2

where d is the ray's direction, b are barycentrics and n normals of the faces there, and j runs over their corners.
"""

from __future__ import annotations  # mi.Float exists only after a variant is set

from collections.abc import Callable
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from registration.render.adjoint import Adjoint, RowSum
from registration.render.cameras import CameraLanes, PixelList
from registration.render.scene import TriangleScene
from registration.render.shading import NO_FACE, ForwardState, Hits, RenderMesh

_BISECTIONS = 6  # of the segment between two pixels' centres
_TOLERANCE = 0.03  # by which barycentrics of a point in the face may be negative


@dataclass(frozen=True, kw_only=True)
class _Side:
    """A face on one side of an intersection curve, relative to a camera."""

    face: mi.UInt32
    normal: mi.Vector3f  # not unit
    distance: mi.Float  # <normal, p - camera centre>, p in the plane; in lengths of the normal

    @classmethod
    def create(cls, mesh: RenderMesh, face: mi.UInt32, centre: mi.Point3f) -> _Side:
        normal, offset = mesh.plane(face)
        return cls(face=face, normal=normal, distance=offset - dr.dot(normal, centre))

    def barycentric(self, mesh: RenderMesh, centre: mi.Point3f, direction: mi.Vector3f) -> list[mi.Float]:
        """Return the barycentric coordinates of a ray's intersection with the plane."""
        p0, p1, p2 = (mesh.position(vertex) for vertex in mesh.corners(self.face))
        x = centre + direction / self.inverse_depth(direction) - p0
        scale = dr.rcp(dr.squared_norm(self.normal))
        b1 = dr.dot(dr.cross(x, p2 - p0), self.normal) * scale
        b2 = dr.dot(dr.cross(p1 - p0, x), self.normal) * scale
        return [1 - b1 - b2, b1, b2]

    def inverse_depth(self, direction: mi.Vector3f) -> mi.Float:
        """Return 1 / depth of the plane along a ray."""
        return dr.dot(self.normal, direction) / self.distance


@dataclass(frozen=True, kw_only=True)
class _Pairs:
    """Neighbouring pixels that see different parts, each pair once."""

    pixel: mi.UInt32  # indices in the list of pixels
    other: mi.UInt32
    step: mi.Vector2f  # from pixel to other, px


def backward(scene: TriangleScene, state: ForwardState, parts: mi.UInt32, adjoint: Adjoint, vertices: RowSum) -> None:
    """Add the intersection curves' part of d(adjoint . image).

    Args:
        scene: the mesh for ray casting.
        state: of the forward rendering.
        parts: (F,) part of each face; part 0 is the largest.
        adjoint: of the image.
        vertices: gradients of positions (columns 0 to 2).
    """
    for hits in state.hits:
        if hits.count:
            pairs = _find_pairs(parts, state.pixels, hits)
            if dr.width(pairs.pixel):
                _add_gradients(scene, state, parts, hits, pairs, adjoint, vertices)
                dr.eval(vertices.total)


def _find_pairs(parts: mi.UInt32, pixels: PixelList, hits: Hits) -> _Pairs:
    """Find the pairs of neighbours of which at least one sees a part other than the largest."""
    small = dr.compress(hits.small)
    if dr.width(small) == 0:
        return _Pairs(pixel=small, other=small, step=mi.Vector2f(0))
    count = dr.opaque(mi.UInt32, dr.width(small))
    lane = dr.arange(mi.UInt32, 4 * dr.width(small))
    neighbour = lane // count
    pixel = dr.gather(mi.UInt32, small, lane - neighbour * count)
    sign = mi.Float(1) - 2 * mi.Float(neighbour >> 1)  # right and down, then left and up
    step = dr.select((neighbour & 1) == 0, mi.Vector2f(sign, 0), mi.Vector2f(0, sign))
    view, x, y = (dr.gather(mi.UInt32, values, pixel) for values in (pixels.view, pixels.x, pixels.y))
    other, listed = pixels.lookup(view, mi.Point2f(mi.Float(x) + 0.5, mi.Float(y) + 0.5) + step, mi.Bool(True))
    face = dr.gather(mi.UInt32, hits.seen, other, listed)
    hit = listed & (face != NO_FACE)
    first, second = (
        dr.gather(mi.UInt32, parts, dr.gather(mi.UInt32, hits.seen, pixel)),
        dr.gather(mi.UInt32, parts, face, hit),
    )
    # A pair of two small parts is found from both of its pixels: count it once.
    differ = hit & (first != second) & ((second == 0) | (sign > 0))
    dr.eval(pixel, other, step, differ)
    lanes = dr.compress(differ)
    pixel, other, step = (dr.gather(type(values), values, lanes) for values in (pixel, other, step))
    return _Pairs(pixel=pixel, other=other, step=step)


def _add_gradients(
    scene: TriangleScene,
    state: ForwardState,
    parts: mi.UInt32,
    hits: Hits,
    pairs: _Pairs,
    adjoint: Adjoint,
    vertices: RowSum,
) -> None:
    """Add the gradients of the intersection points between pairs of pixels; see the module."""
    mesh, pixels = state.mesh, state.pixels
    view, x, y = (dr.gather(mi.UInt32, values, pairs.pixel) for values in (pixels.view, pixels.x, pixels.y))
    camera = pixels.camera(view)
    start = mi.Point2f(mi.Float(x), mi.Float(y)) + dr.opaque(mi.Point2f, hits.offset)

    def ray(s: mi.Float) -> mi.Vector3f:
        point = start + s * pairs.step
        return camera.direction(point.x, point.y)

    faces, active = _bisect(scene, parts, hits.seen, pairs, camera.centre, ray)
    sides = [_Side.create(mesh, face, camera.centre) for face in faces]
    # D at both centres: f is in front of h at the first, behind it at the second.
    before, after = (
        sides[0].inverse_depth(ray(s)) - sides[1].inverse_depth(ray(s)) for s in (mi.Float(0), mi.Float(1))
    )
    s = before / (before - after)
    active &= (
        (before > after) & (s >= 0) & (s < 1) & _crosses_steeply(sides, camera, pairs.step) & ~_adjacent(mesh, faces)
    )
    s = dr.select(active, s, 0.5)
    barycentric = [side.barycentric(mesh, camera.centre, ray(s)) for side in sides]
    for value in (*barycentric[0], *barycentric[1]):
        active &= value > -_TOLERANCE
    values = [state.channels(view, face, b) for face, b in zip(faces, barycentric, strict=True)]
    jump = adjoint.dot([f - h for f, h in zip(*values, strict=True)], dr.select(s < 0.5, pairs.pixel, pairs.other))
    weight = state.ray_weight * jump * dr.square(sides[0].inverse_depth(ray(s))) / (before - after)
    for side, weights, sign in zip(sides, barycentric, (-1, 1), strict=True):
        gradient = sign * weight / dr.dot(side.normal, ray(s)) * side.normal
        for vertex, b in zip(mesh.corners(side.face), weights, strict=True):
            vertices.add(vertex, dr.select(active, b * gradient, 0))


def _bisect(
    scene: TriangleScene,
    parts: mi.UInt32,
    seen: mi.UInt32,
    pairs: _Pairs,
    centre: mi.Point3f,
    ray: Callable[[mi.Float], mi.Vector3f],
) -> tuple[list[mi.UInt32], mi.Bool]:
    """Return faces close to either side of a change of parts, and whether no third part is between them."""
    faces = [dr.gather(mi.UInt32, seen, pixel) for pixel in (pairs.pixel, pairs.other)]
    first, second = (dr.gather(mi.UInt32, parts, face) for face in faces)
    before, after, active = mi.Float(0), mi.Float(1), mi.Bool(True)
    for _ in range(_BISECTIONS):
        middle = 0.5 * (before + after)
        hit = scene.cast_rays(centre, ray(middle), active, coherent=False)
        active &= hit.is_valid()
        part = dr.gather(mi.UInt32, parts, hit.prim_index, active)
        is_first, is_second = active & (part == first), active & (part == second)
        active &= is_first | is_second
        faces = [dr.select(same, hit.prim_index, face) for same, face in zip((is_first, is_second), faces, strict=True)]
        before, after = dr.select(is_first, middle, before), dr.select(is_second, middle, after)
    return faces, active


def _crosses_steeply(sides: list[_Side], camera: CameraLanes, step: mi.Vector2f) -> mi.Bool:
    """Return whether the step's direction, row or column, is the one that crosses the curve more steeply."""
    f, h = sides
    x, y = (
        dr.abs(dr.dot(f.normal, axis) / f.distance - dr.dot(h.normal, axis) / h.distance) / focal
        for axis, focal in ((camera.axes[0], camera.fx), (camera.axes[1], camera.fy))
    )
    return dr.select(step.x != 0, x >= y, y > x)


def _adjacent(mesh: RenderMesh, faces: list[mi.UInt32]) -> mi.Bool:
    """Return whether two faces share a vertex: their values are then continuous."""
    first, second = (mesh.corners(face) for face in faces)
    adjacent = mi.Bool(False)
    for a in first:
        for b in second:
            adjacent |= a == b
    return adjacent
