"""The studio's surfaces with textures and classes, joined to one mesh for ray casting.

Some faces, such as corneas, may be transparent: in RGB images only. In masks, normals and labels they are opaque.
"""

from __future__ import annotations  # mi.Float exists only once a variant is chosen

from collections.abc import Sequence
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np
import torch
from jaxtyping import Bool, Float, Int

from registration.geometry.topology import edges, vertex_normals
from registration.render.scene import TriangleScene


@dataclass(frozen=True, kw_only=True)
class StudioSurface:
    """One diffuse surface, black on its inner side."""

    vertices: Float[np.ndarray, "V 3"]  # world, metres
    triangles: Int[np.ndarray, "F 3"]
    corner_uvs: Float[np.ndarray, "F 3 2"]  # (0, 0) is the texture's lower left corner
    texture: Float[np.ndarray, "R R 3"]  # linear albedo
    classes: Float[np.ndarray, "V K"]  # weights of the studio's classes
    transparent: Bool[np.ndarray, "F"] | None = None  # in RGB images; none if not given
    normals: Float[np.ndarray, "V 3"] | None = None  # unit; the mesh's, weighted by area, if not given


def surface_normals(surface: StudioSurface) -> Float[np.ndarray, "V 3"]:
    """Return the surface's normals, or those of its mesh weighted by area if it has none."""
    if surface.normals is not None:
        return surface.normals
    triangles = torch.as_tensor(surface.triangles.astype(np.int64))
    return vertex_normals(torch.as_tensor(surface.vertices.astype(np.float64)), triangles).numpy()


def subdivide(surface: StudioSurface) -> StudioSurface:
    """Split every face into four without changing the shape; normals, uvs and classes are interpolated."""
    mesh_edges = edges(surface.triangles)
    count, a, b = len(surface.vertices), mesh_edges.vertices[:, 0], mesh_edges.vertices[:, 1]
    midpoint = np.empty((len(surface.triangles), 3), np.int64)  # vertex on the edge that begins at a corner
    index = count + np.arange(len(a))
    for side in range(2):
        exists = mesh_edges.faces[:, side] >= 0
        face, ends = mesh_edges.faces[exists, side], mesh_edges.corners[exists, side] % 3
        # The edge between corners k and k + 1 begins at k, that between 0 and 2 at 2.
        begins = np.where((ends[:, 0] + 1) % 3 == ends[:, 1], ends[:, 0], ends[:, 1])
        midpoint[face, begins] = index[exists]

    def quarters(corner: np.ndarray, between: np.ndarray) -> np.ndarray:
        c, m = (corner[:, k] for k in range(3)), (between[:, k] for k in range(3))
        (c0, c1, c2), (m0, m1, m2) = c, m
        faces = [(c0, m0, m2), (m0, c1, m1), (m2, m1, c2), (m0, m1, m2)]
        return np.concatenate([np.stack(face, 1) for face in faces])

    normals = surface_normals(surface)
    between = normals[a] + normals[b]
    between /= np.maximum(np.linalg.norm(between, axis=1, keepdims=True), 1e-12)
    uvs = surface.corner_uvs
    return StudioSurface(
        vertices=np.concatenate([surface.vertices, (surface.vertices[a] + surface.vertices[b]) / 2]),
        triangles=quarters(surface.triangles.astype(np.int64), midpoint),
        corner_uvs=quarters(uvs, (uvs + np.roll(uvs, -1, 1)) / 2),
        texture=surface.texture,
        classes=np.concatenate([surface.classes, (surface.classes[a] + surface.classes[b]) / 2]),
        transparent=None if surface.transparent is None else np.tile(surface.transparent, 4),
        normals=np.concatenate([normals, between]),
    )


class StudioScene:
    """Surfaces on the device.

    There are two scenes, with and without the transparent faces; these come last, so that the others have the same
    numbers in both.
    """

    def __init__(self, surfaces: Sequence[StudioSurface]):
        first = np.cumsum([0] + [len(surface.vertices) for surface in surfaces])
        self.vertices = np.concatenate([surface.vertices for surface in surfaces]).astype(np.float32)
        self.normals = np.concatenate([surface_normals(surface) for surface in surfaces]).astype(np.float32)
        masks = [np.zeros(len(s.triangles), bool) if s.transparent is None else s.transparent for s in surfaces]
        transparent = np.concatenate([np.asarray(mask) for mask in masks])
        order = np.argsort(transparent, kind="stable")
        triangles = np.concatenate([s.triangles + start for s, start in zip(surfaces, first, strict=False)])[order]
        uvs = np.concatenate([surface.corner_uvs for surface in surfaces])[order].astype(np.float32)
        self.triangles = triangles.astype(np.int64)
        self.opaque_count = int((~transparent).sum())
        self.has_transparent = bool(transparent.any())
        self.class_count = surfaces[0].classes.shape[1]
        positions = torch.as_tensor(self.vertices)
        self._whole = TriangleScene(len(self.vertices), self.triangles)
        self._whole.update_vertices(positions)
        self._opaque = self._whole
        if self.has_transparent:
            self._opaque = TriangleScene(len(self.vertices), self.triangles[: self.opaque_count])
            self._opaque.update_vertices(positions)
        sizes = np.array([surface.texture.shape[0] for surface in surfaces])
        starts = np.cumsum(np.r_[0, sizes[:-1] ** 2])
        owner = np.repeat(np.arange(len(surfaces)), [len(surface.triangles) for surface in surfaces])[order]
        self._faces = mi.UInt32(self.triangles.astype(np.uint32).ravel())
        self._uvs = mi.Float(uvs.ravel())
        self._texture_size = mi.UInt32(sizes[owner].astype(np.uint32))
        self._texture_start = mi.UInt32(starts[owner].astype(np.uint32))
        self._texels = mi.Float(np.concatenate([s.texture.astype(np.float32).ravel() for s in surfaces]))
        self._positions, self._vertex_normals = mi.Float(self.vertices.ravel()), mi.Float(self.normals.ravel())
        self._classes = mi.Float(np.concatenate([s.classes for s in surfaces]).astype(np.float32).ravel())
        dr.eval(self._faces, self._uvs, self._texture_size, self._texture_start, self._texels, self._classes)

    def cast_rays(
        self, origin: mi.Point3f, direction: mi.Vector3f, active: mi.Bool, *, transparent: bool, coherent: bool = True
    ) -> Hit:
        """Return the nearest hits of the whole mesh, or of its opaque faces alone (`transparent` False)."""
        scene = self._whole if transparent else self._opaque
        hit = scene.cast_rays(origin, direction, active, coherent=coherent)
        valid = active & hit.is_valid()
        face = dr.select(valid, hit.prim_index, 0)
        corners = dr.gather(mi.Point3u, self._faces, face, valid)
        # prim_uv is undefined on a miss: without zeros there NaNs would spread.
        b1, b2 = (dr.select(valid, b, 0) for b in (hit.prim_uv.x, hit.prim_uv.y))
        a, b, c = (dr.gather(mi.Point3f, self._positions, corners[k], valid) for k in range(3))
        back_face = dr.dot(dr.cross(b - a, c - a), direction) > 0
        weights = [1 - b1 - b2, b1, b2]
        return Hit(valid=valid, face=face, corners=corners, weights=weights, back_face=back_face, distance=hit.t)

    def normal(self, hit: Hit) -> mi.Vector3f:
        """Return the interpolated unit normal (world) of the side that the ray hits; 0 on a miss."""
        corners = (dr.gather(mi.Vector3f, self._vertex_normals, hit.corners[k], hit.valid) for k in range(3))
        normal = sum((w * n for w, n in zip(hit.weights, corners, strict=True)), mi.Vector3f(0))
        return normal * dr.rsqrt(dr.maximum(dr.squared_norm(normal), 1e-12)) * dr.select(hit.back_face, mi.Float(-1), 1)

    def label(self, hit: Hit) -> mi.UInt32:
        """Return 1 + the class of largest weight; 0 on a miss."""
        rows = [
            dr.gather(
                mi.ArrayXf, self._classes, hit.corners[k], hit.valid, shape=(self.class_count, dr.width(hit.face))
            )
            for k in range(3)
        ]
        best, best_weight = mi.UInt32(0), mi.Float(0)
        for k in range(self.class_count):
            weight = sum((w * row[k] for w, row in zip(hit.weights, rows, strict=True)), mi.Float(0))
            best, best_weight = dr.select(weight > best_weight, k + 1, best), dr.maximum(weight, best_weight)
        return dr.select(hit.valid, best, 0)

    def interpolate(self, values: mi.Float, hit: Hit) -> mi.Color3f:
        """Interpolate vertices' colours (3V flat)."""
        corners = (dr.gather(mi.Color3f, values, hit.corners[k], hit.valid) for k in range(3))
        return sum((w * colour for w, colour in zip(hit.weights, corners, strict=True)), mi.Color3f(0))

    def albedo(self, hit: Hit) -> mi.Color3f:
        """Return the texture's colour by bilinear interpolation; row 0 is at v = 1."""
        corners = (dr.gather(mi.Point2f, self._uvs, 3 * hit.face + k, hit.valid) for k in range(3))
        uv = sum((w * corner for w, corner in zip(hit.weights, corners, strict=True)), mi.Point2f(0))
        size = dr.gather(mi.UInt32, self._texture_size, hit.face, hit.valid)
        start = dr.gather(mi.UInt32, self._texture_start, hit.face, hit.valid)
        x, y = (dr.clip(t * mi.Float(size) - 0.5, 0, mi.Float(size) - 1.001) for t in (uv.x, 1 - uv.y))
        column, row = mi.UInt32(x), mi.UInt32(y)
        index, fx, fy = start + row * size + column, x - mi.Float(column), y - mi.Float(row)

        def texel(index: mi.UInt32) -> mi.Color3f:
            return dr.gather(mi.Color3f, self._texels, index, hit.valid)

        top = dr.lerp(texel(index), texel(index + 1), fx)
        return dr.lerp(top, dr.lerp(texel(index + size), texel(index + size + 1), fx), fy)

    def vertex_albedo(self) -> Float[np.ndarray, "V 3"]:
        """Return the textures' colour near every vertex: the mean over points inside its faces, near their corners."""
        total, count = np.zeros((len(self.vertices), 3)), np.zeros(len(self.vertices))
        face = mi.UInt32(np.arange(len(self.triangles), dtype=np.uint32))
        for k in range(3):
            weights = [mi.Float(0.7 if k == j else 0.15) for j in range(3)]
            hit = Hit(
                valid=mi.Bool(True),
                face=face,
                corners=dr.gather(mi.Point3u, self._faces, face),
                weights=weights,
                back_face=mi.Bool(False),
                distance=mi.Float(0),
            )
            colour = np.array(self.albedo(hit)).T
            for axis in range(3):
                total[:, axis] += np.bincount(self.triangles[:, k], colour[:, axis], len(total))
            count += np.bincount(self.triangles[:, k], minlength=len(total))
        return total / np.maximum(count, 1)[:, None]


@dataclass(frozen=True, kw_only=True)
class Hit:
    """Where rays hit the mesh; one lane per ray."""

    valid: mi.Bool
    face: mi.UInt32
    corners: mi.Point3u  # vertices of the face
    weights: list[mi.Float]  # barycentric
    back_face: mi.Bool  # whether the face's inner side is hit
    distance: mi.Float  # in units of the direction's length
