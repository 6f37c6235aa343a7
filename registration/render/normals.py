"""Face planes and angle-weighted vertex normals [Thürmer 1998] on the device, and the gradient of the latter."""

from __future__ import annotations  # mi.Float exists only after a variant is set

import drjit as dr
import mitsuba as mi

from registration.geometry.topology import LEAST_AREA
from registration.render.adjoint import RowSum
from registration.render.shading import corners, point

_UNIT = 2.0**-40  # of fixed-point sums of unit vectors weighted by angles


def planes_and_normals(faces: mi.UInt32, positions: mi.Float) -> tuple[mi.Float, mi.Float]:
    """Compute face planes and vertex normals.

    Args:
        faces: (F, 4), flat.
        positions: (V, 4), flat, metres.

    Returns:
        Planes (F, 4): outward normal n, whose length is twice the face's area, and <n, p> with p in the plane; vertices
        (V, 4): unit normal and 1 / length of the weighted sum, zero where all faces around a vertex have no area.
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
    """Return length, reciprocal length and direction of area vectors; the latter two are zero without area."""
    size = dr.norm(area)
    inverse = dr.select(size > LEAST_AREA, dr.rcp(size), 0)
    return size, inverse, area * inverse


def _angles(a: mi.Point3f, b: mi.Point3f, c: mi.Point3f, size: mi.Float) -> list[mi.Float]:
    """Return the faces' angles at their corners."""
    return [dr.atan2(size, dr.dot(q - p, r - p)) for p, q, r in ((a, b, c), (b, c, a), (c, a, b))]


def backward(faces: mi.UInt32, positions: mi.Float, normals: mi.Float, gradients: RowSum) -> None:
    """Propagate the gradient of vertex normals to positions; see `interior.backward` for the columns of `gradients`.

    A vertex's sum has each face's unit normal n times the face's angle there. The gradient of the angle at p between
    the edges to q and r is -(n x (q - p)) / |q - p|^2 in q and (n x (r - p)) / |r - p|^2 in r.
    """
    vertices = corners(faces, dr.arange(mi.UInt32, dr.width(faces) // 4))
    a, b, c = (point(positions, vertex) for vertex in vertices)
    size, inverse, unit = _unit(dr.cross(b - a, c - a))
    angles, table, sum_gradients = _angles(a, b, c, size), gradients.table(), []
    for vertex in vertices:
        row, g = dr.gather(mi.Vector4f, normals, vertex), point(table, 2 * vertex + 1)
        normal = mi.Vector3f(row.x, row.y, row.z)
        sum_gradients.append((g - normal * dr.dot(normal, g)) * row.w)
    direction = angles[0] * sum_gradients[0] + angles[1] * sum_gradients[1] + angles[2] * sum_gradients[2]
    direction = (direction - unit * dr.dot(unit, direction)) * inverse
    to_b, to_c = dr.cross(c - a, direction), dr.cross(direction, b - a)
    position_gradient = [-to_b - to_c, to_b, to_c]
    edges = [b - a, c - b, a - c]  # from each corner to the next
    across = [dr.cross(unit, e) * dr.select(inverse > 0, dr.rcp(dr.squared_norm(e)), 0) for e in edges]
    for k, g in enumerate(sum_gradients):
        # The edge to the next corner starts at this one; the edge from the previous corner ends here.
        opening, after, before = dr.dot(unit, g), (k + 1) % 3, (k + 2) % 3
        position_gradient[after] -= opening * across[k]
        position_gradient[before] -= opening * across[before]
        position_gradient[k] += opening * (across[k] + across[before])
    for vertex, value in zip(vertices, position_gradient, strict=True):
        gradients.add(vertex, value)
    dr.eval(gradients.total)
