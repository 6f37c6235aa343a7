"""The gradient of curves in which parts of the mesh run through one another: lids and eyeballs, gums and teeth, lips.

Such a curve bounds what is seen as a silhouette does, but no edge of the mesh marks it. It is found between the centres
of neighbouring pixels that see different parts: a few rays halve the way from one to the other until faces f and h lie
close to either side of the change. Along the line 1 / depth of a face's plane is linear, so that the planes meet at

    s = D_1 / (D_1 - D_2),   D = 1 / depth_f - 1 / depth_h

D_1 at the first centre, D_2 at the second. If that is where the change is and f is the nearer before it, they run
through one another there; else one hides the other, and the silhouettes know. A
curve that is steeper than 45 degrees in the image is counted where it crosses rows, any other where it crosses columns:
each such point stands for one pixel of the curve's extent, and with the adjoint g of the pixel that it lies in

    dLoss = g . (value_f - value_h) ds,   ds = dD / (D_1 - D_2),
    dD = (sum_j b_hj <n_h, dx_hj> / <n_h, d> - sum_j b_fj <n_f, dx_fj> / <n_f, d>) / depth^2

where d is the ray's direction, b are barycentrics and n normals of the faces there, and j runs over their corners.
"""

from __future__ import annotations  # mi.Float exists only once a variant is chosen

from collections.abc import Callable
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from registration.render.adjoint import Adjoint, RowSum
from registration.render.cameras import CameraLanes, PixelList
from registration.render.scene import TriangleScene
from registration.render.shading import NO_FACE, Drawn, Hits, Surface

_HALVINGS = 6  # of the way between two pixels' centres
_SLACK = 0.03  # of the barycentrics of a point that still counts as one of the face


@dataclass(frozen=True, kw_only=True)
class _Side:
    """A face on one side of a crossing, seen along a camera's rays."""

    face: mi.UInt32
    normal: mi.Vector3f  # not unit
    reach: mi.Float  # <normal, plane - centre>

    @classmethod
    def of(cls, surface: Surface, face: mi.UInt32, centre: mi.Point3f) -> _Side:
        normal, offset = surface.plane(face)
        return cls(face=face, normal=normal, reach=offset - dr.dot(normal, centre))

    def shares(self, surface: Surface, centre: mi.Point3f, direction: mi.Vector3f) -> list[mi.Float]:
        """Barycentrics of where a ray meets the plane."""
        p0, p1, p2 = (surface.position(vertex) for vertex in surface.corners(self.face))
        x = centre + direction / self.nearness(direction) - p0
        scale = dr.rcp(dr.squared_norm(self.normal))
        b1 = dr.dot(dr.cross(x, p2 - p0), self.normal) * scale
        b2 = dr.dot(dr.cross(p1 - p0, x), self.normal) * scale
        return [1 - b1 - b2, b1, b2]

    def nearness(self, direction: mi.Vector3f) -> mi.Float:
        """1 / depth of the plane along a ray."""
        return dr.dot(self.normal, direction) / self.reach


def backward(scene: TriangleScene, drawn: Drawn, parts: mi.UInt32, adjoint: Adjoint, vertices: RowSum) -> None:
    """Add the crossings' part of d(adjoint . image) to the gradient of positions.

    `parts` (F,) numbers the parts of the mesh; part 0 covers most of what is seen.
    """
    for hits in drawn.hits:
        if hits.count:
            pixel, other, step = _pairs(parts, drawn.pixels, hits)
            if dr.width(pixel):
                _cross(scene, drawn, parts, hits, pixel, other, step, adjoint, vertices)
                dr.eval(vertices.total)


def _pairs(parts: mi.UInt32, pixels: PixelList, hits: Hits) -> tuple[mi.UInt32, mi.UInt32, mi.Vector2f]:
    """Neighbours that see different parts, each pair once: two places in the list, and the step between them (px)."""
    own = dr.compress(hits.small)
    if dr.width(own) == 0:
        return own, own, mi.Vector2f(0)
    count = dr.opaque(mi.UInt32, dr.width(own))
    lane = dr.arange(mi.UInt32, 4 * dr.width(own))
    turn = lane // count
    pixel = dr.gather(mi.UInt32, own, lane - turn * count)
    ahead = mi.Float(1) - 2 * mi.Float(turn >> 1)  # right and down, then left and up
    step = dr.select((turn & 1) == 0, mi.Vector2f(ahead, 0), mi.Vector2f(0, ahead))
    view, x, y = (dr.gather(mi.UInt32, values, pixel) for values in (pixels.view, pixels.x, pixels.y))
    other, listed = pixels.at(view, mi.Point2f(mi.Float(x) + 0.5, mi.Float(y) + 0.5) + step, mi.Bool(True))
    face = dr.gather(mi.UInt32, hits.seen, other, listed)
    met = listed & (face != NO_FACE)
    first, second = (
        dr.gather(mi.UInt32, parts, dr.gather(mi.UInt32, hits.seen, pixel)),
        dr.gather(mi.UInt32, parts, face, met),
    )
    # A pair of small parts is met from both of its pixels.
    differ = met & (first != second) & ((second == 0) | (ahead > 0))
    dr.eval(pixel, other, step, differ)
    lanes = dr.compress(differ)
    return tuple(dr.gather(type(values), values, lanes) for values in (pixel, other, step))


def _cross(
    scene: TriangleScene,
    drawn: Drawn,
    parts: mi.UInt32,
    hits: Hits,
    pixel: mi.UInt32,
    other: mi.UInt32,
    step: mi.Vector2f,
    adjoint: Adjoint,
    vertices: RowSum,
) -> None:
    surface, pixels = drawn.surface, drawn.pixels
    view, x, y = (dr.gather(mi.UInt32, values, pixel) for values in (pixels.view, pixels.x, pixels.y))
    camera = pixels.camera(view)
    start = mi.Point2f(mi.Float(x), mi.Float(y)) + dr.opaque(mi.Point2f, hits.offset)

    def ray(s: mi.Float) -> mi.Vector3f:
        point = start + s * step
        return camera.direction(point.x, point.y)

    faces, active = _halve(scene, parts, hits.seen, pixel, other, camera.centre, ray)
    sides = [_Side.of(surface, face, camera.centre) for face in faces]
    # D at both centres: where f is before h, and behind it.
    before, after = (sides[0].nearness(ray(s)) - sides[1].nearness(ray(s)) for s in (mi.Float(0), mi.Float(1)))
    s = before / (before - after)
    active &= (before > after) & (s >= 0) & (s < 1) & _steeper(sides, camera, step) & ~_touch(surface, faces)
    s = dr.select(active, s, 0.5)
    shares = [side.shares(surface, camera.centre, ray(s)) for side in sides]
    for value in (*shares[0], *shares[1]):
        active &= value > -_SLACK
    values = [drawn.channels(view, face, part) for face, part in zip(faces, shares, strict=True)]
    jump = adjoint.times([f - h for f, h in zip(*values, strict=True)], dr.select(s < 0.5, pixel, other))
    weight = drawn.share * jump * dr.square(sides[0].nearness(ray(s))) / (before - after)
    for side, part, sign in zip(sides, shares, (-1, 1), strict=True):
        push = sign * weight / dr.dot(side.normal, ray(s)) * side.normal
        for vertex, b in zip(surface.corners(side.face), part, strict=True):
            vertices.add(vertex, dr.select(active, b * push, 0))


def _halve(
    scene: TriangleScene,
    parts: mi.UInt32,
    seen: mi.UInt32,
    pixel: mi.UInt32,
    other: mi.UInt32,
    centre: mi.Point3f,
    ray: Callable[[mi.Float], mi.Vector3f],
) -> tuple[list[mi.UInt32], mi.Bool]:
    """The faces close to either side of a change of parts, and whether no third part came between."""
    faces = [dr.gather(mi.UInt32, seen, place) for place in (pixel, other)]
    first, second = (dr.gather(mi.UInt32, parts, face) for face in faces)
    before, after, active = mi.Float(0), mi.Float(1), mi.Bool(True)
    for _ in range(_HALVINGS):
        middle = 0.5 * (before + after)
        hit = scene.cast_rays(centre, ray(middle), active, coherent=False)
        active &= hit.is_valid()
        part = dr.gather(mi.UInt32, parts, hit.prim_index, active)
        is_first, is_second = active & (part == first), active & (part == second)
        active &= is_first | is_second
        faces = [dr.select(here, hit.prim_index, face) for here, face in zip((is_first, is_second), faces, strict=True)]
        before, after = dr.select(is_first, middle, before), dr.select(is_second, middle, after)
    return faces, active


def _steeper(sides: list[_Side], camera: CameraLanes, step: mi.Vector2f) -> mi.Bool:
    """Whether the step, along rows or columns, is the one that crosses the curve the more steeply."""
    f, h = sides
    x, y = (
        dr.abs(dr.dot(f.normal, axis) / f.reach - dr.dot(h.normal, axis) / h.reach) / focal
        for axis, focal in ((camera.axes[0], camera.fx), (camera.axes[1], camera.fy))
    )
    return dr.select(step.x != 0, x >= y, y > x)


def _touch(surface: Surface, faces: list[mi.UInt32]) -> mi.Bool:
    """Whether two faces share a vertex: then they are one surface, and their values agree where they meet."""
    first, second = (surface.corners(face) for face in faces)
    touch = mi.Bool(False)
    for a in first:
        for b in second:
            touch |= a == b
    return touch
