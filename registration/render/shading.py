"""What a surface point looks like, unshaded: texture colour, world normal, soft classes, mask.

Everything is a Dr.Jit gather; looking a point up needs its face, its barycentrics and which side of it is seen. Tables
have rows of four numbers: a row is one load (and one store, where gradients are summed), several times as fast as
four.
"""

from __future__ import annotations  # mi.Float exists only once a variant is chosen

import functools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from jaxtyping import Shaped

from registration.render.cameras import PixelList

NO_FACE = 0xFFFFFFFF
MASK = 6  # the channel of coverage
GROUPS = (slice(0, 3), slice(3, 6), slice(MASK, 7), slice(7, None))  # channels: colour, normal, mask, classes


@dataclass(frozen=True, kw_only=True)
class Hits:
    """What the rays through one point of all pixels met, or of P chosen ones."""

    offset: tuple[float, float]  # that point, from the pixel's corner (px)
    seen: mi.UInt32  # P: the face, or NO_FACE
    depth: mi.Float  # P, metres; infinite where nothing was met
    pixel: mi.UInt32  # N, of those that met a face
    face: mi.UInt32  # N
    b1: mi.Float  # N, barycentric of the face's second corner
    b2: mi.Float  # N, and of its third
    small: mi.Bool | None  # P: whether it is of another part than the largest; None if there is but one part

    @property
    def count(self) -> int:
        return dr.width(self.pixel)

    @property
    def shares(self) -> list[mi.Float]:
        """Barycentrics of all three corners."""
        return [1 - self.b1 - self.b2, self.b1, self.b2]


@dataclass(frozen=True, kw_only=True)
class Footprint:
    """The four texels around a point of the texture, and where between them it lies."""

    first: mi.UInt32  # texel; the others are next to it, below it and both
    fx: mi.Float
    fy: mi.Float
    inside: mi.Vector2f  # 1, or 0 where it was clamped: beyond the outermost texels' centres nothing changes
    size: int

    @classmethod
    def of(cls, uv: mi.Point2f, size: int) -> Footprint:
        """Bilinear, clamped at the border. Row 0 of the texture is at v = 1. What is not a number lies in a corner."""
        position = mi.Point2f(uv.x, 1 - uv.y) * size - 0.5
        # Barycentrics of rays that miss are anything; as an integer NaN would be a place 8 GB before the texture.
        clamped = dr.clip(dr.select(dr.isnan(position), 0, position), 0, size - 1.001)
        column, row = mi.UInt32(clamped.x), mi.UInt32(clamped.y)
        return cls(
            first=row * size + column,
            fx=clamped.x - mi.Float(column),
            fy=clamped.y - mi.Float(row),
            inside=dr.select(position == clamped, mi.Vector2f(1), 0),
            size=size,
        )

    def texels(self) -> list[tuple[mi.UInt32, mi.Float]]:
        """Index and share of each."""
        shares = [(1 - self.fx) * (1 - self.fy), self.fx * (1 - self.fy), (1 - self.fx) * self.fy, self.fx * self.fy]
        return [(self.first + step, w) for step, w in zip((0, 1, self.size, self.size + 1), shares, strict=True)]

    def slopes(self, values: Sequence[mi.Vector3f]) -> tuple[mi.Vector3f, mi.Vector3f]:
        """d/du and d/dv of what lies between four texels' values."""
        du = dr.lerp(values[1] - values[0], values[3] - values[2], self.fy)
        dv = dr.lerp(values[2] - values[0], values[3] - values[1], self.fx)
        return self.size * self.inside.x * du, -self.size * self.inside.y * dv


@dataclass(frozen=True, kw_only=True)
class Surface:
    """The tables of one mesh on the device."""

    faces: mi.UInt32  # (F, 4): vertices, 0
    corner_uvs: mi.Float  # (F, 8): three uvs, 0
    classes: mi.Float  # (V, class_count and what fills up a multiple of four)
    class_count: int
    positions: mi.Float  # (V, 4), world, metres
    planes: mi.Float  # (F, 4): n, <n, p>; see `normals`
    normals: mi.Float  # (V, 4), unit
    texture: mi.Float | None  # (R R, 3), row 0 at v = 1
    texture_size: int

    @property
    def vertex_count(self) -> int:
        return dr.width(self.positions) // 4

    @property
    def face_count(self) -> int:
        return dr.width(self.faces) // 4

    def corners(self, face: mi.UInt32, active: mi.Bool | bool = True) -> list[mi.UInt32]:
        return corners(self.faces, face, active)

    def position(self, vertex: mi.UInt32, active: mi.Bool | bool = True) -> mi.Point3f:
        return point(self.positions, vertex, active)

    def plane(self, face: mi.UInt32) -> tuple[mi.Vector3f, mi.Float]:
        """Normal n (not unit) and <n, p>, with p in the plane."""
        row = dr.gather(mi.Vector4f, self.planes, face)
        return mi.Vector3f(row.x, row.y, row.z), row.w

    def normal(self, vertex: mi.UInt32) -> mi.Vector3f:
        return mi.Vector3f(point(self.normals, vertex))

    def vertex_classes(self, vertex: mi.UInt32) -> list[mi.Float]:
        rows = -(-self.class_count // 4)
        loaded = [dr.gather(mi.Vector4f, self.classes, rows * vertex + k) for k in range(rows)]
        return [share for row in loaded for share in row][: self.class_count]

    def uvs(self, face: mi.UInt32) -> list[mi.Point2f]:
        """Of the three corners."""
        first, second = (dr.gather(mi.Vector4f, self.corner_uvs, 2 * face + k) for k in range(2))
        return [mi.Point2f(first.x, first.y), mi.Point2f(first.z, first.w), mi.Point2f(second.x, second.y)]

    def corner_uv(self, corner: mi.UInt32) -> mi.Point2f:
        """Of one of all faces' corners."""
        return dr.gather(mi.Point2f, self.corner_uvs, corner + corner // 3)  # four uvs a row, three of them used

    def footprint(self, shares: Sequence[mi.Float], uvs: Sequence[mi.Point2f]) -> Footprint:
        return Footprint.of(blend(shares, uvs), self.texture_size)

    def colour(
        self, shares: Sequence[mi.Float], uvs: Sequence[mi.Point2f]
    ) -> tuple[mi.Vector3f, tuple[mi.Vector3f, mi.Vector3f]]:
        """The texture's colour at a blend of uvs, and its d/du and d/dv; black without a texture."""
        if self.texture is None:
            return mi.Vector3f(0), (mi.Vector3f(0), mi.Vector3f(0))
        footprint = self.footprint(shares, uvs)
        indices, parts = zip(*footprint.texels(), strict=True)
        values = [dr.gather(mi.Vector3f, self.texture, index) for index in indices]
        return blend(parts, values), footprint.slopes(values)

    def shade(
        self, shares: Sequence[mi.Float], vertices: Sequence[mi.UInt32], colour: mi.Vector3f, facing: mi.Bool
    ) -> list[mi.Float]:
        """The channels of a point that has a share of each of some vertices, of a face whose outer side is `facing`."""
        normal = blend(shares, [self.normal(vertex) for vertex in vertices])
        # A scanner's normals point to the camera, on the inner side of a face too.
        normal *= dr.rsqrt(dr.maximum(dr.squared_norm(normal), 1e-12)) * dr.select(facing, mi.Float(1), -1)
        classes = [blend(shares, values) for values in zip(*map(self.vertex_classes, vertices), strict=True)]
        return [*colour, *normal, mi.Float(1), *classes]


@dataclass(frozen=True, kw_only=True)
class Drawn:
    """One drawing, as its adjoint needs it."""

    surface: Surface
    pixels: PixelList
    facing: mi.Bool  # (N F): whether a view sees a face's outer side
    hits: list[Hits]  # one for each ray of every pixel
    finer: list[Hits]  # of further rays, through pixels that are partly covered
    weights: mi.Float | None  # P: of one of a pixel's rays; None: it has but one
    slopes: list[list[mi.Vector3f]]  # of `rays`: d(colour) / d(b_1) and / d(b_2)

    @property
    def share(self) -> float:
        """Of one of the rays that every pixel has, were there no more."""
        return 1 / len(self.hits)

    def weight(self, hits: Hits) -> mi.Float | float:
        """What these hits count in their pixels."""
        return 1.0 if self.weights is None else dr.gather(mi.Float, self.weights, hits.pixel)

    @property
    def rays(self) -> list[Hits]:
        return [*self.hits, *self.finer]

    @property
    def deepest(self) -> mi.Float:
        """The greatest depth that any ray of a pixel found."""
        return functools.reduce(dr.maximum, (hits.depth for hits in self.hits))

    def sees_outside(self, view: mi.UInt32, face: mi.UInt32) -> mi.Bool:
        return dr.gather(mi.Bool, self.facing, view * dr.opaque(mi.UInt32, self.surface.face_count) + face)

    def channels(self, view: mi.UInt32, face: mi.UInt32, shares: Sequence[mi.Float]) -> list[mi.Float]:
        """What a view sees at barycentrics of a face."""
        surface = self.surface
        colour, _ = surface.colour(shares, surface.uvs(face))
        return surface.shade(shares, surface.corners(face), colour, self.sees_outside(view, face))


def blend(shares: Sequence[mi.Float], values: Sequence[Any]) -> Any:
    total = shares[0] * values[0]
    for share, value in zip(shares[1:], values[1:], strict=True):
        total += share * value
    return total


def corners(faces: mi.UInt32, face: mi.UInt32, active: mi.Bool | bool = True) -> list[mi.UInt32]:
    """The vertices of faces, from their table."""
    row = dr.gather(mi.Vector4u, faces, face, active)
    return [row.x, row.y, row.z]


def point(table: mi.Float, row: mi.UInt32, active: mi.Bool | bool = True) -> mi.Point3f:
    """The first three of four columns."""
    values = dr.gather(mi.Vector4f, table, row, active)
    return mi.Point3f(values.x, values.y, values.z)


def rows(table: Shaped[np.ndarray, "N D"], width: int = 4) -> Shaped[np.ndarray, "M"]:
    """A flat table whose rows are filled up with zeros to a multiple of `width`."""
    return np.pad(table, ((0, 0), (0, -table.shape[1] % width))).ravel()


def rows_of_four(table: mi.Float) -> mi.Float:
    """A flat table of three columns as one of four."""
    values = dr.gather(mi.Point3f, table, dr.arange(mi.UInt32, dr.width(table) // 3))
    return dr.ravel(mi.Vector4f(*values, 0))
