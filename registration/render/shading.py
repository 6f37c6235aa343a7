"""What a surface point looks like, unshaded: texture colour, world normal, soft classes, mask.

Everything is a Dr.Jit gather; looking a point up needs its face, its barycentrics and where it is seen from.
"""

from __future__ import annotations  # mi.Float exists only once a variant is chosen

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

MASK = 6  # the channel of coverage
GROUPS = (slice(0, 3), slice(3, 6), slice(MASK, 7), slice(7, None))  # channels: colour, normal, mask, classes


@dataclass(frozen=True, kw_only=True)
class Corners:
    """The three corners of one face per lane. Gradients stop here: lanes are summed to vertices in a fixed order."""

    face: mi.UInt32
    vertices: list[mi.UInt32]
    positions: list[mi.Point3f]
    normals: list[mi.Vector3f]

    def barycentrics(self, origin: mi.Point3f, direction: mi.Vector3f) -> tuple[mi.Float, mi.Float]:
        """Where a fixed ray meets the plane of the face (Moeller and Trumbore); differentiable in `positions`."""
        a, b, c = self.positions
        ab, ac = b - a, c - a
        p = dr.cross(direction, ac)
        scale = dr.rcp(dr.dot(ab, p))
        t = origin - a
        return dr.dot(t, p) * scale, dr.dot(direction, dr.cross(t, ab)) * scale

    def from_behind(self, direction: mi.Vector3f) -> mi.Bool:
        """Whether a ray meets the inner side of the face: a scanner's normals point to the camera there too."""
        a, b, c = (dr.detach(position) for position in self.positions)
        return dr.dot(dr.cross(b - a, c - a), direction) > 0


@dataclass(frozen=True, kw_only=True)
class Surface:
    """The arrays of one mesh on the device. `positions` and `normals` may carry gradients, `texture` too."""

    faces: mi.UInt32  # 3F
    corner_uvs: mi.Float  # 6F
    classes: mi.Float  # V * class_count
    class_count: int
    positions: mi.Float  # 3V, world, metres
    normals: mi.Float  # 3V, unit
    texture: mi.Float | None  # 3 R^2, row 0 at v = 1
    texture_size: int

    @property
    def vertex_count(self) -> int:
        return dr.width(self.positions) // 3

    def corners(self, face: mi.UInt32, active: mi.Bool | bool = True) -> mi.Point3u:
        return dr.gather(mi.Point3u, self.faces, face, active)

    def position(self, vertex: mi.UInt32, active: mi.Bool | bool = True) -> mi.Point3f:
        return dr.gather(mi.Point3f, self.positions, vertex, active)

    def load(self, face: mi.UInt32, active: mi.Bool | bool = True) -> Corners:
        corners = self.corners(face, active)
        vertices = [corners[k] for k in range(3)]
        return Corners(
            face=face,
            vertices=vertices,
            positions=[self.position(v, active) for v in vertices],
            normals=[dr.gather(mi.Vector3f, self.normals, v, active) for v in vertices],
        )

    def shade(
        self, corners: Corners, b1: mi.Float, b2: mi.Float, direction: mi.Vector3f, active: mi.Bool
    ) -> list[mi.Float]:
        """The channels of (face; 1 - b1 - b2, b1, b2) seen along `direction`; zero where not active."""
        return self._mix(
            [1 - b1 - b2, b1, b2],
            corners.normals,
            corners.vertices,
            [3 * corners.face + k for k in range(3)],
            corners.from_behind(direction),
            active,
        )

    def shade_edge(
        self,
        face: mi.UInt32,
        vertex: mi.Point2u,
        corner: mi.Point2u,
        t: mi.Float,
        direction: mi.Vector3f,
        active: mi.Bool,
    ) -> list[mi.Float]:
        """The channels of a point on a face's edge, at share t of the way from its first to its second end."""
        behind = self.load(face, active).from_behind(direction)
        ends = [vertex.x, vertex.y]
        normals = [dr.gather(mi.Vector3f, self.normals, v, active) for v in ends]
        return self._mix([1 - t, t], normals, ends, [corner.x, corner.y], behind, active)

    def _mix(
        self,
        weights: list[mi.Float],
        normals: list[mi.Vector3f],
        vertices: list[mi.UInt32],
        corners: list[mi.UInt32],
        behind: mi.Bool,
        active: mi.Bool,
    ) -> list[mi.Float]:
        # prim_uv is undefined on a miss: weights must be silenced there or NaNs spread.
        weights = [dr.select(active, w, 0) for w in weights]
        normal = sum((w * n for w, n in zip(weights, normals, strict=True)), mi.Vector3f(0))
        normal *= dr.rsqrt(dr.maximum(dr.squared_norm(normal), 1e-12)) * dr.select(behind, mi.Float(-1), 1)
        classes = [mi.Float(0)] * self.class_count
        for w, v in zip(weights, vertices, strict=True):
            row = dr.gather(mi.ArrayXf, self.classes, v, active, shape=(self.class_count, dr.width(v)))
            classes = [total + w * row[k] for k, total in enumerate(classes)]
        colour = [mi.Float(0)] * 3
        if self.texture is not None:
            uvs = [dr.gather(mi.Point2f, self.corner_uvs, c, active) for c in corners]
            colour = list(
                self._lookup(sum((w * uv for w, uv in zip(weights, uvs, strict=True)), mi.Point2f(0)), active)
            )
        mask = dr.select(active, mi.Float(1), 0)
        return [*colour, normal.x, normal.y, normal.z, mask, *classes]

    def _lookup(self, uv: mi.Point2f, active: mi.Bool) -> mi.Color3f:
        def texel(index: mi.UInt32) -> mi.Color3f:
            return dr.gather(mi.Color3f, self.texture, index, active)

        index, fx, fy = texel_footprint(uv, self.texture_size)
        top = dr.lerp(texel(index), texel(index + 1), fx)
        bottom = dr.lerp(texel(index + self.texture_size), texel(index + self.texture_size + 1), fx)
        return dr.lerp(top, bottom, fy)


def texel_footprint(uv: mi.Point2f, size: int) -> tuple[mi.UInt32, mi.Float, mi.Float]:
    """The first texel of a bilinear footprint and the position inside it. Row 0 of the texture is at v = 1."""
    x = dr.clip(uv.x * size - 0.5, 0, size - 1.001)
    y = dr.clip((1 - uv.y) * size - 0.5, 0, size - 1.001)
    column, row = mi.UInt32(dr.detach(x)), mi.UInt32(dr.detach(y))
    return row * size + column, x - mi.Float(column), y - mi.Float(row)
