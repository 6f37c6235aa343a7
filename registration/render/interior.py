"""The gradient of the image inside faces, where visibility does not change.

A ray from o along d hits a face with corners p_0, p_1, p_2 at barycentric coordinates b and sees the values
sum_j b_j v_j there. Let g be the pixel's adjoint and A_j = <g, v_j> the derivative of the loss in b_j. When corner j
moves by x, the face moves by b_j x under the fixed ray; only the component that is not along d changes b, so that

    dLoss/dp_j = -b_j w,  w = ((A_1 - A_0) e_2 x d + (A_2 - A_0) d x e_1) / <e_1 x e_2, d>,  e_j = p_j - p_0

No ray is cast again and no data are stored per lane: each lane adds its gradients to the tables of vertices and texels.
"""

from __future__ import annotations  # mi.Float exists only after a variant is set

import drjit as dr
import mitsuba as mi

from registration.render.adjoint import Adjoint, RowSum
from registration.render.shading import ForwardState, Hits, RenderMesh, TexelFootprint, blend


def backward(state: ForwardState, number: int, adjoint: Adjoint, vertices: RowSum, texels: RowSum | None) -> None:
    """Add d(adjoint . image) of the hits of one ray per pixel.

    Args:
        state: of the forward rendering.
        number: index of the ray in `state.rays`.
        adjoint: of the image.
        vertices: gradients of positions (columns 0 to 2) and normals (4 to 6).
        texels: gradients of the texture; None: not needed.
    """
    mesh, pixels, hits = state.mesh, state.pixels, state.rays[number]
    weight = state.weight(hits)
    view = dr.gather(mi.UInt32, pixels.view, hits.pixel)
    b = hits.barycentric
    corners = mesh.corners(hits.face)
    slope = [mi.Float(0) for _ in range(3)]  # A
    _classes(mesh, hits, corners, adjoint, slope)
    normal = _normals(mesh, hits, corners, state.faces_camera(view, hits.face), adjoint, slope)
    colour = _colour(hits, state.slopes[number], adjoint, slope)
    if colour is not None and texels is not None:
        footprint = mesh.footprint(b, mesh.uvs(hits.face))
        splat(texels, footprint, weight * mi.Vector4f(*colour, 0))
    p0, p1, p2 = (mesh.position(corner) for corner in corners)
    direction = blend(b, [p0, p1, p2]) - pixels.centre(view)
    e1, e2 = p1 - p0, p2 - p0
    w = (slope[1] - slope[0]) * dr.cross(e2, direction) + (slope[2] - slope[0]) * dr.cross(direction, e1)
    w *= weight * dr.rcp(dr.dot(dr.cross(e1, e2), direction))
    for corner, b_j in zip(corners, b, strict=True):
        normal_gradient = [] if normal is None else [mi.Float(0), *(weight * b_j * normal)]
        vertices.add(corner, [*(-b_j * w), *normal_gradient])
    dr.eval(vertices.total)


def _classes(mesh: RenderMesh, hits: Hits, corners: list[mi.UInt32], adjoint: Adjoint, slope: list[mi.Float]) -> None:
    """Add the classes' part of A."""
    g = adjoint.classes(hits.pixel)
    if g is None:
        return
    for j, corner in enumerate(corners):
        for k, value in enumerate(mesh.vertex_classes(corner)):
            slope[j] = dr.fma(g[k], value, slope[j])


def _normals(
    mesh: RenderMesh,
    hits: Hits,
    corners: list[mi.UInt32],
    facing: mi.Bool,
    adjoint: Adjoint,
    slope: list[mi.Float],
) -> mi.Vector3f | None:
    """Add the normals' part of A; return dLoss / d(interpolated normal before normalization)."""
    g = adjoint.normal(hits.pixel)
    if g is None:
        return None
    normals = [mesh.normal(corner) for corner in corners]
    normal = blend(hits.barycentric, normals)
    inverse = dr.rsqrt(dr.maximum(dr.squared_norm(normal), 1e-12))
    unit = normal * inverse
    g = (g - unit * dr.dot(unit, g)) * (inverse * dr.select(facing, mi.Float(1), -1))
    for j in range(3):
        slope[j] += dr.dot(g, normals[j])
    return g


def _colour(hits: Hits, slopes: list[mi.Vector3f], adjoint: Adjoint, slope: list[mi.Float]) -> mi.Vector3f | None:
    """Add the colour's part of A; return dLoss / d(colour)."""
    g = adjoint.colour(hits.pixel)
    if g is not None:
        slope[1] += dr.dot(g, slopes[0])
        slope[2] += dr.dot(g, slopes[1])
    return g


def splat(texels: RowSum, footprint: TexelFootprint, value: mi.Vector4f) -> None:
    """Add the lanes' values to the texels of their footprints: the transpose of the bilinear look-up."""
    for texel, weight in footprint.texels():
        texels.add(texel, weight * value)
    dr.eval(texels.total)
