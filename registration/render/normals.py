"""Normals on the device: of faces, of vertices (weighted by the areas of the faces around), and their gradient."""

from __future__ import annotations  # mi.Float exists only once a variant is chosen

import drjit as dr
import mitsuba as mi

from registration.render.adjoint import RowSum
from registration.render.shading import corners, point

_UNIT = 2.0**-40  # of a sum, in the largest face's area


def planes_and_normals(faces: mi.UInt32, positions: mi.Float) -> tuple[mi.Float, mi.Float]:
    """Two tables, from those of faces (F, 4) and positions (V, 4).

    Faces' planes (n, <n, p>), n outward and twice as long as the face is large, p in the plane; and of the vertices
    (unit normal, 1 / length of the sum it comes from), zero where a vertex has no area around it.
    """
    vertices = corners(faces, dr.arange(mi.UInt32, dr.width(faces) // 4))
    a, b, c = (point(positions, vertex) for vertex in vertices)
    area = dr.cross(b - a, c - a)
    planes = dr.ravel(mi.Vector4f(*area, dr.dot(area, a)))
    dr.eval(planes, area)
    count = dr.width(positions) // 4
    sums = RowSum(count, dr.maximum(dr.max(dr.max(dr.abs(area), axis=0)), 1e-30) * _UNIT)
    for vertex in vertices:
        sums.add(vertex, area)
    total = point(sums.table(), dr.arange(mi.UInt32, count))
    length = dr.norm(total)
    inverse = dr.select(length > 1e-20, dr.rcp(length), 0)
    return planes, dr.ravel(mi.Vector4f(*(total * inverse), inverse))


def backward(faces: mi.UInt32, positions: mi.Float, normals: mi.Float, gradients: RowSum) -> None:
    """Add to the gradient of positions what that of normals makes of it; see `interior.backward`."""
    vertices = corners(faces, dr.arange(mi.UInt32, dr.width(faces) // 4))
    a, b, c = (point(positions, vertex) for vertex in vertices)
    table, total = gradients.table(), mi.Vector3f(0)
    for vertex in vertices:
        row, g = dr.gather(mi.Vector4f, normals, vertex), point(table, 2 * vertex + 1)
        unit = mi.Vector3f(row.x, row.y, row.z)
        total += (g - unit * dr.dot(unit, g)) * row.w
    to_b, to_c = dr.cross(c - a, total), dr.cross(total, b - a)
    for vertex, value in zip(vertices, (-to_b - to_c, to_b, to_c), strict=True):
        gradients.add(vertex, value)
    dr.eval(gradients.total)
