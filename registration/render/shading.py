"""The channels of surface points, without lighting: texture colour, world normal, mask, soft classes.

Everything is a Dr.Jit gather from a face, barycentric coordinates and the visible side. Tables have rows of four
numbers, because loading (or adding to) a row at once is several times as fast as four single numbers.
"""

from __future__ import annotations  # mi.Float exists only after a variant is set

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
    """Hits of the rays through one position in all pixels, or in P chosen ones."""

    offset: tuple[float, float]  # that position, from the pixel's corner (px)
    seen: mi.UInt32  # P: the visible face, or NO_FACE
    depth: mi.Float  # P, metres; infinite where nothing was hit
    pixel: mi.UInt32  # N: the pixels whose rays hit a face
    face: mi.UInt32  # N
    b1: mi.Float  # N, barycentric of the face's second corner
    b2: mi.Float  # N, barycentric of the third corner
    small: mi.Bool | None  # P: whether the face is not in the largest part; None if the mesh has one part

    @property
    def count(self) -> int:
        """N."""
        return dr.width(self.pixel)

    @property
    def barycentric(self) -> list[mi.Float]:
        """Barycentric coordinates of all three corners."""
        return [1 - self.b1 - self.b2, self.b1, self.b2]


@dataclass(frozen=True, kw_only=True)
class TexelFootprint:
    """The four texels around a point of the texture, and its position between their centres."""

    first: mi.UInt32  # texel; the others are right of it, below it, and right below it
    fx: mi.Float
    fy: mi.Float
    inside: mi.Vector2f  # 0 where clamped: beyond the outermost texels' centres the derivative is zero; else 1
    size: int

    @classmethod
    def from_uv(cls, uv: mi.Point2f, size: int) -> TexelFootprint:
        """Return the bilinear footprint of uvs, clamped at the border. Row 0 of the texture is at v = 1."""
        position = mi.Point2f(uv.x, 1 - uv.y) * size - 0.5
        # NaN uvs (of rays that miss) are clamped to texel (0, 0): as an index, NaN would read out of bounds.
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
        """Return index and weight of each texel."""
        weights = [(1 - self.fx) * (1 - self.fy), self.fx * (1 - self.fy), (1 - self.fx) * self.fy, self.fx * self.fy]
        return [(self.first + step, w) for step, w in zip((0, 1, self.size, self.size + 1), weights, strict=True)]

    def slopes(self, values: Sequence[mi.Vector3f]) -> tuple[mi.Vector3f, mi.Vector3f]:
        """Return d/du and d/dv of the bilinear interpolation of the four texels' values."""
        du = dr.lerp(values[1] - values[0], values[3] - values[2], self.fy)
        dv = dr.lerp(values[2] - values[0], values[3] - values[1], self.fx)
        return self.size * self.inside.x * du, -self.size * self.inside.y * dv


@dataclass(frozen=True, kw_only=True)
class RenderMesh:
    """The tables of one mesh on the device: V vertices, F faces, a texture of R x R texels."""

    faces: mi.UInt32  # (F, 4): vertices, 0
    corner_uvs: mi.Float  # (F, 8): three uvs, 0
    classes: mi.Float  # (V, class_count rounded up to a multiple of four)
    class_count: int
    positions: mi.Float  # (V, 4), world, metres
    planes: mi.Float  # (F, 4): n, <n, p>; see `normals`
    normals: mi.Float  # (V, 4), unit
    texture: mi.Float | None  # (R R, 3), row 0 at v = 1
    texture_size: int

    @property
    def vertex_count(self) -> int:
        """V."""
        return dr.width(self.positions) // 4

    @property
    def face_count(self) -> int:
        """F."""
        return dr.width(self.faces) // 4

    def corners(self, face: mi.UInt32, active: mi.Bool | bool = True) -> list[mi.UInt32]:
        """Return the three vertices of faces."""
        return corners(self.faces, face, active)

    def position(self, vertex: mi.UInt32, active: mi.Bool | bool = True) -> mi.Point3f:
        """Return the positions of vertices, world, metres."""
        return point(self.positions, vertex, active)

    def plane(self, face: mi.UInt32) -> tuple[mi.Vector3f, mi.Float]:
        """Return the outward normal n (not unit) and <n, p>, with p in the plane."""
        row = dr.gather(mi.Vector4f, self.planes, face)
        return mi.Vector3f(row.x, row.y, row.z), row.w

    def normal(self, vertex: mi.UInt32) -> mi.Vector3f:
        """Return the unit normals of vertices."""
        return mi.Vector3f(point(self.normals, vertex))

    def vertex_classes(self, vertex: mi.UInt32) -> list[mi.Float]:
        """Return the class weights of vertices."""
        rows = -(-self.class_count // 4)
        loaded = [dr.gather(mi.Vector4f, self.classes, rows * vertex + k) for k in range(rows)]
        return [weight for row in loaded for weight in row][: self.class_count]

    def uvs(self, face: mi.UInt32) -> list[mi.Point2f]:
        """Return the uvs of the three corners of faces."""
        first, second = (dr.gather(mi.Vector4f, self.corner_uvs, 2 * face + k) for k in range(2))
        return [mi.Point2f(first.x, first.y), mi.Point2f(first.z, first.w), mi.Point2f(second.x, second.y)]

    def corner_uv(self, corner: mi.UInt32) -> mi.Point2f:
        """Return the uv of a corner, numbered 3 * face + k."""
        return dr.gather(mi.Point2f, self.corner_uvs, corner + corner // 3)  # rows have four uvs, three of them used

    def footprint(self, weights: Sequence[mi.Float], uvs: Sequence[mi.Point2f]) -> TexelFootprint:
        """Return the texels around a weighted sum of uvs."""
        return TexelFootprint.from_uv(blend(weights, uvs), self.texture_size)

    def colour(
        self, weights: Sequence[mi.Float], uvs: Sequence[mi.Point2f]
    ) -> tuple[mi.Vector3f, tuple[mi.Vector3f, mi.Vector3f]]:
        """Return the texture's colour at a weighted sum of uvs, with d/du and d/dv; black without a texture."""
        if self.texture is None:
            return mi.Vector3f(0), (mi.Vector3f(0), mi.Vector3f(0))
        footprint = self.footprint(weights, uvs)
        indices, texel_weights = zip(*footprint.texels(), strict=True)
        values = [dr.gather(mi.Vector3f, self.texture, index) for index in indices]
        return blend(texel_weights, values), footprint.slopes(values)

    def shade(
        self, weights: Sequence[mi.Float], vertices: Sequence[mi.UInt32], colour: mi.Vector3f, facing: mi.Bool
    ) -> list[mi.Float]:
        """Return the channels of a weighted sum of vertices.

        Args:
            weights: of the vertices; sum 1.
            vertices: the corners of a face, or the ends of an edge.
            colour: linear RGB.
            facing: whether the outer side of the face is visible.
        """
        normal = blend(weights, [self.normal(vertex) for vertex in vertices])
        # As in captures, normals point to the camera, also on the inner side of a face.
        normal *= dr.rsqrt(dr.maximum(dr.squared_norm(normal), 1e-12)) * dr.select(facing, mi.Float(1), -1)
        classes = [blend(weights, values) for values in zip(*map(self.vertex_classes, vertices), strict=True)]
        return [*colour, *normal, mi.Float(1), *classes]


@dataclass(frozen=True, kw_only=True)
class ForwardState:
    """What the adjoint of a rendering needs of its forward pass."""

    mesh: RenderMesh
    pixels: PixelList
    facing: mi.Bool  # (N F): whether a face's outer side faces the camera of a view
    hits: list[Hits]  # one per ray of every pixel
    finer: list[Hits]  # of further rays, through partly covered pixels
    weights: mi.Float | None  # P: of each of a pixel's rays; None: one ray per pixel
    slopes: list[list[mi.Vector3f]]  # per item of `rays`: d(colour) / d(b_1) and d(colour) / d(b_2)

    @property
    def ray_weight(self) -> float:
        """The weight of one of the rays that every pixel has."""
        return 1 / len(self.hits)

    def weight(self, hits: Hits) -> mi.Float | float:
        """Return the weight of hits in their pixels."""
        return 1.0 if self.weights is None else dr.gather(mi.Float, self.weights, hits.pixel)

    @property
    def rays(self) -> list[Hits]:
        """The hits of all rays."""
        return [*self.hits, *self.finer]

    @property
    def max_depth(self) -> mi.Float:
        """The greatest depth that any ray of a pixel hit, metres."""
        return functools.reduce(dr.maximum, (hits.depth for hits in self.hits))

    def faces_camera(self, view: mi.UInt32, face: mi.UInt32) -> mi.Bool:
        """Return whether the outer sides of faces face the camera of a view."""
        return dr.gather(mi.Bool, self.facing, view * dr.opaque(mi.UInt32, self.mesh.face_count) + face)

    def channels(self, view: mi.UInt32, face: mi.UInt32, barycentric: Sequence[mi.Float]) -> list[mi.Float]:
        """Return the channels that a view sees at barycentric coordinates of faces."""
        mesh = self.mesh
        colour, _ = mesh.colour(barycentric, mesh.uvs(face))
        return mesh.shade(barycentric, mesh.corners(face), colour, self.faces_camera(view, face))


def blend(weights: Sequence[mi.Float], values: Sequence[Any]) -> Any:
    """Return the weighted sum of values."""
    total = weights[0] * values[0]
    for weight, value in zip(weights[1:], values[1:], strict=True):
        total += weight * value
    return total


def corners(faces: mi.UInt32, face: mi.UInt32, active: mi.Bool | bool = True) -> list[mi.UInt32]:
    """Return the three vertices of faces from the table (F, 4)."""
    row = dr.gather(mi.Vector4u, faces, face, active)
    return [row.x, row.y, row.z]


def point(table: mi.Float, row: mi.UInt32, active: mi.Bool | bool = True) -> mi.Point3f:
    """Return the first three of four columns of a table's rows."""
    values = dr.gather(mi.Vector4f, table, row, active)
    return mi.Point3f(values.x, values.y, values.z)


def rows(table: Shaped[np.ndarray, "N D"], width: int = 4) -> Shaped[np.ndarray, "M"]:
    """Return a flat table whose rows are padded with zeros to a multiple of `width`."""
    return np.pad(table, ((0, 0), (0, -table.shape[1] % width))).ravel()


def rows_of_four(table: mi.Float) -> mi.Float:
    """Return a flat table of three columns as one of four."""
    values = dr.gather(mi.Point3f, table, dr.arange(mi.UInt32, dr.width(table) // 3))
    return dr.ravel(mi.Vector4f(*values, 0))
