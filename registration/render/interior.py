"""The gradient of what is seen inside the faces, where nothing comes into sight or leaves it.

A ray from o along d meets a face with corners p_0, p_1, p_2 at barycentrics b, and sees the values sum_j b_j v_j there.
Let g be the pixel's adjoint. Along the face the loss changes by A_j = <g, v_j> per b_j. When corner j moves by x, the
face slips under the fixed ray by b_j x less what of it is along d, so that

    dLoss/dp_j = -b_j w,  w = ((A_1 - A_0) e_2 x d + (A_2 - A_0) d x e_1) / <e_1 x e_2, d>,  e_j = p_j - p_0

Nothing is traced again, and nothing of a lane is kept: each adds its gradients to the tables of vertices and texels.
"""

from __future__ import annotations  # mi.Float exists only once a variant is chosen

import drjit as dr
import mitsuba as mi

from registration.render.adjoint import Adjoint, RowSum
from registration.render.shading import Drawn, Footprint, Hits, Surface, blend


def backward(drawn: Drawn, number: int, adjoint: Adjoint, vertices: RowSum, texels: RowSum | None) -> None:
    """Add d(adjoint . image) of what one ray of each pixel met.

    To rows of `vertices`: to position (columns 0 to 2) and normal (4 to 6); to texels, if asked.
    """
    surface, pixels, hits = drawn.surface, drawn.pixels, drawn.rays[number]
    share = drawn.weight(hits)
    view = dr.gather(mi.UInt32, pixels.view, hits.pixel)
    b = hits.shares
    corners = surface.corners(hits.face)
    change = [mi.Float(0) for _ in range(3)]  # A
    _classes(surface, hits, corners, adjoint, change)
    normal = _normals(surface, hits, b, corners, drawn.sees_outside(view, hits.face), adjoint, change)
    _colour(surface, hits, drawn.slopes[number], adjoint, change, texels, share)
    p0, p1, p2 = (surface.position(corner) for corner in corners)
    direction = blend(b, [p0, p1, p2]) - pixels.centre(view)
    e1, e2 = p1 - p0, p2 - p0
    slip = (change[1] - change[0]) * dr.cross(e2, direction) + (change[2] - change[0]) * dr.cross(direction, e1)
    slip *= share * dr.rcp(dr.dot(dr.cross(e1, e2), direction))
    for corner, part in zip(corners, b, strict=True):
        normal_part = [] if normal is None else [mi.Float(0), *(share * part * normal)]
        vertices.add(corner, [*(-part * slip), *normal_part])
    dr.eval(vertices.total)


def _classes(surface: Surface, hits: Hits, corners: list[mi.UInt32], adjoint: Adjoint, change: list[mi.Float]) -> None:
    g = adjoint.classes(hits.pixel)
    if g is None:
        return
    for j, corner in enumerate(corners):
        for k, value in enumerate(surface.vertex_classes(corner)):
            change[j] = dr.fma(g[k], value, change[j])


def _normals(
    surface: Surface,
    hits: Hits,
    b: list[mi.Float],
    corners: list[mi.UInt32],
    facing: mi.Bool,
    adjoint: Adjoint,
    change: list[mi.Float],
) -> mi.Vector3f | None:
    """dLoss / d(interpolated normal before it is made unit)."""
    g = adjoint.normal(hits.pixel)
    if g is None:
        return None
    normals = [surface.normal(corner) for corner in corners]
    normal = blend(b, normals)
    inverse = dr.rsqrt(dr.maximum(dr.squared_norm(normal), 1e-12))
    unit = normal * inverse
    g = (g - unit * dr.dot(unit, g)) * (inverse * dr.select(facing, mi.Float(1), -1))
    for j in range(3):
        change[j] += dr.dot(g, normals[j])
    return g


def _colour(
    surface: Surface,
    hits: Hits,
    slopes: list[mi.Vector3f],
    adjoint: Adjoint,
    change: list[mi.Float],
    texels: RowSum | None,
    share: mi.Float | float,
) -> None:
    g = adjoint.colour(hits.pixel)
    if g is None:
        return
    change[1] += dr.dot(g, slopes[0])
    change[2] += dr.dot(g, slopes[1])
    if texels is not None:
        carry_back(texels, surface.footprint(hits.shares, surface.uvs(hits.face)), share * mi.Vector4f(*g, 0))


def carry_back(texels: RowSum, footprint: Footprint, value: mi.Vector4f) -> None:
    """Add what pixels hold to the texels that they show: the transpose of the look-up."""
    for texel, share in footprint.texels():
        texels.add(texel, share * value)
    dr.eval(texels.total)
