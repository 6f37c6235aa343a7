"""Which face each pixel shows, by rasterization: on the CPU half the time of casting a ray per pixel.

A lane per face and view visits the pixels in the box around the face's projection. Where a pixel's position lies in the
face, it keeps the smallest (depth, face), as one number of 64 bits: the result does not depend on the order of lanes.
Faces are visible from both sides. Barycentrics are those of the surface point, perspective correct.
"""

from __future__ import annotations  # mi.Float exists only after a variant is set

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from registration.render.cameras import PixelList
from registration.render.shading import NO_FACE, corners, point

_NOTHING = 0xFFFFFFFFFFFFFFFF
# Of a face's area: positions outside by less count as inside, so that none falls between two faces by rounding.
_TOLERANCE = 1e-5


@dataclass(frozen=True, kw_only=True)
class VisibleFaces:
    """What P pixels show."""

    face: mi.UInt32  # or NO_FACE
    depth: mi.Float  # along the optical axis, metres; infinite without a face
    b1: mi.Float  # barycentric of the face's second corner
    b2: mi.Float  # of the third


def rasterize(
    faces: mi.UInt32, positions: mi.Float, pixels: PixelList, offset: tuple[float, float]
) -> VisibleFaces | None:
    """Find what is seen through one position in each pixel.

    Args:
        faces: (F, 4), vertices.
        positions: (V, 4), world, metres.
        pixels: the list.
        offset: the position, from the pixels' corners (px).

    Returns:
        None if a vertex lies beside or behind a camera: such faces have no projection.
    """
    vertex_count = dr.width(positions) // 4
    projected = _project(positions, vertex_count, pixels)
    nearest = dr.min(dr.gather(mi.Float, projected, 4 * dr.arange(mi.UInt32, dr.width(projected) // 4) + 2))
    if not float(dr.slice(nearest, 0)) > 0:
        return None
    table = _Projections(faces=faces, rows=projected, vertex_count=dr.opaque(mi.UInt32, vertex_count))
    dx, dy = (dr.opaque(mi.Float, value) for value in offset)
    best = _nearest(table, pixels, dx, dy)
    face, depth = mi.UInt32(best & NO_FACE), dr.reinterpret_array(mi.Float, mi.UInt32(best >> 32))
    hit = face != NO_FACE
    rows = table.corners(pixels.view, face, hit)
    areas = _areas(rows, mi.Float(pixels.x) + dx, mi.Float(pixels.y) + dy)
    shares = [area / row.z for area, row in zip(areas, rows, strict=True)]
    scale = dr.rcp(shares[0] + shares[1] + shares[2])
    b1, b2 = (dr.select(hit, dr.clip(share * scale, 0, 1), 0) for share in shares[1:])
    return VisibleFaces(face=face, depth=dr.select(hit, depth, dr.inf), b1=b1, b2=b2)


@dataclass(frozen=True, kw_only=True)
class _Projections:
    """The vertices as the views see them."""

    faces: mi.UInt32
    rows: mi.Float  # (N V, 4): x, y (px), depth (m), 0
    vertex_count: mi.UInt32

    def corners(self, view: mi.UInt32, face: mi.UInt32, active: mi.Bool | bool = True) -> list[mi.Vector4f]:
        """Return the rows of the corners of faces."""
        first = view * self.vertex_count
        return [dr.gather(mi.Vector4f, self.rows, first + c, active) for c in corners(self.faces, face, active)]


def _project(positions: mi.Float, vertex_count: int, pixels: PixelList) -> mi.Float:
    count = dr.opaque(mi.UInt32, vertex_count)
    lane = dr.arange(mi.UInt32, pixels.camera_count * vertex_count)
    view = lane // count
    place, depth = pixels.camera(view).project(point(positions, lane - view * count))
    rows = dr.ravel(mi.Vector4f(place.x, place.y, depth, 0))
    dr.eval(rows)
    return rows


def _nearest(table: _Projections, pixels: PixelList, dx: mi.Float, dy: mi.Float) -> mi.UInt64:
    """Depth and face of the nearest face at each listed pixel, or `_NOTHING`."""
    face_count = dr.width(table.faces) // 4
    faces_per_view = dr.opaque(mi.UInt32, face_count)
    width, height = (dr.opaque(mi.UInt32, side) for side in (pixels.width_px, pixels.height_px))
    lane = dr.arange(mi.UInt32, pixels.camera_count * face_count)
    view = lane // faces_per_view
    a, b, c = table.corners(view, lane - view * faces_per_view)
    box, some = [], (b.x - a.x) * (c.y - a.y) != (c.x - a.x) * (b.y - a.y)
    for k, side, shift in ((0, width, dx), (1, height, dy)):
        low, high = dr.minimum(dr.minimum(a[k], b[k]), c[k]), dr.maximum(dr.maximum(a[k], b[k]), c[k])
        low, high = dr.ceil(dr.maximum(low - shift, 0)), dr.floor(dr.minimum(high - shift, mi.Float(side) - 1))
        some &= low <= high
        box += [low, high]
    table_of_boxes = dr.ravel(mi.Vector4u(*(mi.UInt32(dr.select(some, side, 0)) for side in box)))
    dr.eval(table_of_boxes, some)
    best = dr.full(mi.UInt64, _NOTHING, pixels.count)
    dr.make_opaque(best)
    lane = dr.compress(some)
    if dr.width(lane) == 0:
        return best
    box = dr.gather(mi.Vector4u, table_of_boxes, lane)
    view = lane // faces_per_view
    face = lane - view * faces_per_view
    rows = table.corners(view, face)
    inverse_depths = [dr.rcp(row.z) for row in rows]
    per_area = dr.rcp(sum(_areas(rows, rows[0].x, rows[0].y)))
    first, number = view * (width * height), mi.UInt64(face)

    def visit(x: mi.UInt32, y: mi.UInt32) -> tuple[mi.UInt32, mi.UInt32]:
        shares = [area * per_area for area in _areas(rows, mi.Float(x) + dx, mi.Float(y) + dy)]
        inside = dr.minimum(dr.minimum(shares[0], shares[1]), shares[2]) >= -_TOLERANCE
        pixel = dr.gather(mi.Int32, pixels.index, first + y * width + x, inside)
        depth = dr.rcp(sum(share * inverse for share, inverse in zip(shares, inverse_depths, strict=True)))
        key = (mi.UInt64(dr.reinterpret_array(mi.UInt32, depth)) << 32) | number  # positive floats sort as their bits
        dr.scatter_reduce(dr.ReduceOp.Min, best, key, mi.UInt32(pixel), inside & (pixel >= 0))
        last = x >= box.y
        return dr.select(last, box.x, x + 1), dr.select(last, y + 1, y)

    dr.while_loop((mi.UInt32(box.x), mi.UInt32(box.z)), lambda x, y: y <= box.w, visit)
    dr.eval(best)
    return best


def _areas(rows: list[mi.Vector4f], x: mi.Float, y: mi.Float) -> list[mi.Float]:
    """Twice the signed areas of the triangles between an image position and each edge, opposite to the corners."""
    x, y = [row.x - x for row in rows], [row.y - y for row in rows]
    return [x[i] * y[j] - x[j] * y[i] for i, j in ((1, 2), (2, 0), (0, 1))]
