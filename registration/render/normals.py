"""Normals on the device: of faces, of vertices (weighted by the angles of the faces around), and their gradient."""

from __future__ import annotations  # mi.Float exists only once a variant is chosen

import drjit as dr
import mitsuba as mi

from registration.geometry.topology import LEAST_AREA
from registration.render.adjoint import RowSum
from registration.render.shading import corners, point

_UNIT = 2.0**-40  # of a sum of unit vectors weighted by angles


def planes_and_normals(faces: mi.UInt32, positions: mi.Float) -> tuple[mi.Float, mi.Float]:
    """Two tables, from those of faces (F, 4) and positions (V, 4).

    Faces' planes (n, <n, p>), n outward and twice as long as the face is large, p in the plane; and of the vertices
    (unit normal, 1 / length of the sum it comes from), zero where a vertex has no area around it.
    """
    vertices = corners(faces, dr.arange(mi.UInt32, dr.width(faces) // 4))
    a, b, c = (point(positions, vertex) for vertex in vertices)
    area = dr.cross(b - a, c - a)
    planes = dr.ravel(mi.Vector4f(*area, dr.dot(area, a)))
    size, _, unit = _unit(area)
    count = dr.width(positions) // 4
    sums = RowSum(count, dr.opaque(mi.Float, _UNIT))
    for vertex, angle in zip(vertices, _angles(a, b, c, size), strict=True):
        sums.add(vertex, unit * angle)
    dr.eval(planes, sums.total)
    total = point(sums.table(), dr.arange(mi.UInt32, count))
    length = dr.norm(total)
    inverse = dr.select(length > 1e-20, dr.rcp(length), 0)
    return planes, dr.ravel(mi.Vector4f(*(total * inverse), inverse))


def _unit(area: mi.Vector3f) -> tuple[mi.Float, mi.Float, mi.Vector3f]:
    """Length of faces' area vectors, and one over it and their directions, zero for faces without area."""
    size = dr.norm(area)
    inverse = dr.select(size > LEAST_AREA, dr.rcp(size), 0)
    return size, inverse, area * inverse


def _angles(a: mi.Point3f, b: mi.Point3f, c: mi.Point3f, size: mi.Float) -> list[mi.Float]:
    """The faces' angles at their corners."""
    return [dr.atan2(size, dr.dot(q - p, r - p)) for p, q, r in ((a, b, c), (b, c, a), (c, a, b))]


def backward(faces: mi.UInt32, positions: mi.Float, normals: mi.Float, gradients: RowSum) -> None:
    """Add to the gradient of positions what that of normals makes of it; see `interior.backward`.

    A vertex' sum takes from each face its unit normal n times its angle there. The angle at p between the edges to q
    and r grows by -(n x (q - p)) / |q - p|^2 per motion of q, by (n x (r - p)) / |r - p|^2 per motion of r.
    """
    vertices = corners(faces, dr.arange(mi.UInt32, dr.width(faces) // 4))
    a, b, c = (point(positions, vertex) for vertex in vertices)
    size, inverse, unit = _unit(dr.cross(b - a, c - a))
    angles, table, wanted = _angles(a, b, c, size), gradients.table(), []
    for vertex in vertices:
        row, g = dr.gather(mi.Vector4f, normals, vertex), point(table, 2 * vertex + 1)
        normal = mi.Vector3f(row.x, row.y, row.z)
        wanted.append((g - normal * dr.dot(normal, g)) * row.w)
    turn = angles[0] * wanted[0] + angles[1] * wanted[1] + angles[2] * wanted[2]
    turn = (turn - unit * dr.dot(unit, turn)) * inverse
    to_b, to_c = dr.cross(c - a, turn), dr.cross(turn, b - a)
    motion = [-to_b - to_c, to_b, to_c]
    edges = [b - a, c - b, a - c]  # from each corner to the next
    across = [dr.cross(unit, e) * dr.select(inverse > 0, dr.rcp(dr.squared_norm(e)), 0) for e in edges]
    for k, g in enumerate(wanted):
        # The edge to the corner after runs from here; that to the corner before runs hither.
        opening, after, before = dr.dot(unit, g), (k + 1) % 3, (k + 2) % 3
        motion[after] -= opening * across[k]
        motion[before] -= opening * across[before]
        motion[k] += opening * (across[k] + across[before])
    for vertex, value in zip(vertices, motion, strict=True):
        gradients.add(vertex, value)
    dr.eval(gradients.total)
