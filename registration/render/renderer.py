"""The differentiable renderer without lighting: one Dr.Jit wavefront over chosen pixels of several views.

The forward pass sees through one or more points of a pixel and averages them with a box filter. The adjoint has three
parts: the interior of faces at the hits (`interior.py`, nothing is searched again), silhouettes (`silhouette.py`), and
curves in which parts of the mesh intersect (`intersection_curves.py`).
"""

from __future__ import annotations  # mi.Float exists only after a variant is set

import functools
import math
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from registration.geometry.topology import connected_parts, edges
from registration.render import interior, intersection_curves, normals, silhouette, visibility
from registration.render.adjoint import Adjoint, RowSum, unit_of
from registration.render.cameras import PixelList, upload
from registration.render.scene import TriangleScene
from registration.render.shading import GROUPS, NO_FACE, ForwardState, Hits, RenderMesh, rows, rows_of_four
from registration.types import Pixels, Rendered, SurfaceHits

_CENTRE = (0.5, 0.5)
_PARTIAL_RAYS = 16  # of a partly covered pixel, if anti-aliased: coverage error 0.035 rms; with 4 rays 0.1


class Renderer:
    """Renders one topology; vertices, texture and cameras may change from call to call."""

    def __init__(
        self,
        triangles: Int[np.ndarray, "F 3"],
        corner_uvs: Float[np.ndarray, "F 3 2"],
        vertex_classes: Float[np.ndarray, "V K"],
        *,
        parts: Int[np.ndarray, "F"] | None = None,
        pixel_samples: int = 1,
        edge_samples: float = 1.0,
        seed: int = 0,
    ):
        """
        Args:
            triangles: of vertices that are not duplicated at uv seams.
            corner_uvs: in [0, 1]^2 of one atlas; (0, 0) is the texture's lower left corner.
            vertex_classes: soft class weights of the vertices.
            parts: number of each face's part; parts may intersect. None: the connected parts.
            pixel_samples: rays per pixel, averaged; 1 is the pixel's centre, which aliases but is sufficient for a fit.
                With more, pixels in which some rays hit the mesh and others miss it get at least 16.
            edge_samples: silhouette samples per pixel of projected silhouette length, in the adjoint; 0: no
                silhouette gradients.
            seed: of these samples; every backward pass uses new ones.

        Raises:
            InputError: the mesh is not manifold.
        """
        vertex_count, self._class_count = vertex_classes.shape
        self._scene = TriangleScene(vertex_count, triangles)
        self._edges = silhouette.upload(edges(triangles), corner_uvs)
        self._faces = mi.UInt32(rows(triangles.astype(np.uint32)))
        self._corner_uvs = mi.Float(rows(corner_uvs.astype(np.float32).reshape(-1, 6), 8))
        self._classes = mi.Float(rows(vertex_classes.astype(np.float32)))
        self._parts = _ranked_parts(connected_parts(triangles) if parts is None else parts)
        self._pixel_offsets, self._finer_offsets = _pixel_offsets(pixel_samples)
        self._edge_samples = edge_samples
        self._seed = seed
        self._last: tuple[Pixels, ForwardState] | None = None
        dr.eval(self._faces, self._corner_uvs, self._classes)

    def __call__(
        self, vertices: Float[Tensor, "V 3"], texture: Float[Tensor, "R R 3"] | None, pixels: Pixels
    ) -> Rendered:
        """Render pixels; differentiable in vertices and texture.

        Args:
            vertices: world, metres.
            texture: linear, row 0 at v = 1; None: the RGB channels are zero and cost nothing.
            pixels: which pixels of which cameras.
        """
        rgb, normal, mask, classes = _RenderFunction.apply(vertices, texture, self, pixels)
        return Rendered(rgb=rgb, normals=normal, mask=mask, classes=classes)

    def unwrap(
        self,
        vertices: Float[Tensor, "V 3"],
        values: Float[Tensor, "P 3"],
        weights: Float[Tensor, "P"],
        pixels: Pixels,
        texture_size: int,
    ) -> tuple[Float[Tensor, "R R 3"], Float[Tensor, "R R"]]:
        """Accumulate pixels in the texture, by the transpose of the bilinear look-up. Not differentiable.

        Args:
            vertices: world, metres.
            values: of the pixels.
            weights: of the pixels.
            pixels: which pixels of which cameras.
            texture_size: R.

        Returns:
            The weighted sum of `values` in each texel, and the sum of weights.
        """
        with torch.no_grad(), dr.suspend_grad():
            hits = self._hits(vertices, pixels)
            weighted = torch.cat([values * weights[:, None], weights[:, None]], -1)
            texels = RowSum(texture_size**2, unit_of([weighted]))
            if hits.count:
                mesh = self._mesh(vertices, None, texture_size)
                footprint = mesh.footprint(hits.barycentric, mesh.uvs(hits.face))
                interior.splat(texels, footprint, dr.gather(mi.Vector4f, _flat(weighted), hits.pixel))
            image = _tensor(texels.table()).view(texture_size, texture_size, 4)
            return image[..., :3], image[..., 3]

    def surface(self, vertices: Float[Tensor, "V 3"], pixels: Pixels) -> SurfaceHits:
        """Return which points of the mesh the centres of pixels show. Not differentiable.

        Args:
            vertices: world, metres.
            pixels: which pixels of which cameras.
        """
        with torch.no_grad(), dr.suspend_grad():
            hits = self._hits(vertices, pixels)
            pixel, face = (_tensor(mi.Int64(index)) for index in (hits.pixel, hits.face))
            barycentric = torch.stack([_tensor(share) for share in hits.barycentric], -1)
            return SurfaceHits(pixel=pixel, face=face, barycentric=barycentric)

    def depth(self, vertices: Float[Tensor, "V 3"], pixels: Pixels) -> Float[Tensor, "P"]:
        """Return the depth of the mesh at the pixels' centres. Not differentiable.

        Args:
            vertices: world, metres.
            pixels: which pixels of which cameras.

        Returns:
            Distance along each camera's axis, metres; inf where the mesh is missed.
        """
        with torch.no_grad(), dr.suspend_grad():
            return _tensor(self._hits(vertices, pixels).depth)

    def _hits(self, vertices: Tensor, pixels: Pixels) -> Hits:
        """Those of the pixels' centres. Usually the same pixels were rendered just before: their hits are reused."""
        self._update_vertices(vertices)
        if self._last is not None and self._last[0] is pixels and len(self._pixel_offsets) == 1:
            return self._last[1].hits[0]
        return self._see(rows_of_four(_flat(vertices)), upload(pixels), _CENTRE)

    def _update_vertices(self, vertices: Tensor) -> None:
        """Set the vertices; the cached forward pass of other vertices is dropped."""
        if self._scene.update_vertices(vertices):
            self._last = None

    def _mesh(self, vertices: Tensor, texture: Tensor | None, texture_size: int = 0) -> RenderMesh:
        positions = rows_of_four(_flat(vertices))
        planes, vertex_normals = normals.planes_and_normals(self._faces, positions)
        return RenderMesh(
            faces=self._faces,
            corner_uvs=self._corner_uvs,
            classes=self._classes,
            class_count=self._class_count,
            positions=positions,
            planes=planes,
            normals=vertex_normals,
            texture=None if texture is None else _flat(texture),
            texture_size=texture_size if texture is None else texture.shape[0],
        )

    def _see(self, positions: mi.Float, pixels: PixelList, offset: tuple[float, float]) -> Hits:
        """The hits of rays through all pixels; on the CPU without casting them."""
        seen = visibility.rasterize(self._faces, positions, pixels, offset) if "llvm" in mi.variant() else None
        if seen is None:
            return self._cast(pixels, offset)
        return self._collected(offset, seen.face, seen.depth, seen.b1, seen.b2)

    def _cast(self, pixels: PixelList, offset: tuple[float, float], which: mi.UInt32 | None = None) -> Hits:
        hit = self._scene.cast_rays(*pixels.rays(offset, which), mi.Bool(True), coherent=True)
        is_hit = hit.is_valid()
        depth, seen = dr.select(is_hit, hit.t, dr.inf), dr.select(is_hit, hit.prim_index, NO_FACE)
        return self._collected(offset, seen, depth, hit.prim_uv.x, hit.prim_uv.y, which)

    def _collected(
        self,
        offset: tuple[float, float],
        seen: mi.UInt32,
        depth: mi.Float,
        b1: mi.Float,
        b2: mi.Float,
        which: mi.UInt32 | None = None,
    ) -> Hits:
        """The hits of pixels, all or those of some, as lists."""
        is_hit, small = seen != NO_FACE, None
        if self._parts is not None:
            small = is_hit & (dr.gather(mi.UInt32, self._parts, seen, is_hit) != 0)
        dr.eval(is_hit, depth, seen, b1, b2, small)
        lane = dr.compress(is_hit)
        face, b1, b2 = (dr.gather(type(values), values, lane) for values in (seen, b1, b2))
        pixel = lane if which is None else dr.gather(mi.UInt32, which, lane)
        return Hits(offset=offset, seen=seen, depth=depth, pixel=pixel, face=face, b1=b1, b2=b2, small=small)

    def _cast_finer(self, pixels: PixelList, hits: list[Hits]) -> tuple[list[Hits], mi.Float | None]:
        """Cast further rays in partly covered pixels; return their hits and the weight of each pixel's rays.

        Adaptive supersampling [Whitted 1980].
        """
        if not self._finer_offsets:
            return [], None if len(hits) == 1 else dr.full(mi.Float, 1 / len(hits), pixels.count)
        min_depth, max_depth = (functools.reduce(f, (h.depth for h in hits)) for f in (dr.minimum, dr.maximum))
        partly = dr.isfinite(min_depth) & ~dr.isfinite(max_depth)
        total = len(hits) + len(self._finer_offsets)
        weights = dr.select(partly, mi.Float(1 / total), 1 / len(hits))
        dr.eval(partly, weights)
        which = dr.compress(partly)
        finer = [self._cast(pixels, offset, which) for offset in self._finer_offsets] if dr.width(which) else []
        return finer, weights

    def _render(self, mesh: RenderMesh, pixels: PixelList) -> tuple[ForwardState, list[mi.Float | None]]:
        """Return the state for the adjoint and the groups of channels, each flat; no colour without a texture."""
        facing = silhouette.facing(mesh, pixels)
        dr.eval(facing)
        hits = [self._see(mesh.positions, pixels, offset) for offset in self._pixel_offsets]
        finer, weights = self._cast_finer(pixels, hits)
        state = ForwardState(
            mesh=mesh,
            pixels=pixels,
            facing=facing,
            hits=hits,
            finer=finer,
            weights=weights,
            slopes=[],
        )
        widths = [0 if mesh.texture is None else 3, 3, 1, mesh.class_count]
        image = [dr.zeros(mi.Float, width * pixels.count) if width else None for width in widths]
        for ray in state.rays:
            state.slopes.append(self._shade(state, ray, image) if ray.count else [])
        dr.sync_thread()
        return state, image

    def _shade(self, state: ForwardState, hits: Hits, image: list[mi.Float | None]) -> list[mi.Vector3f]:
        """Add one ray's channels to every pixel; return the slopes of the colour."""
        mesh = state.mesh
        uvs = mesh.uvs(hits.face)
        colour, (du, dv) = mesh.colour(hits.barycentric, uvs)
        facing = state.faces_camera(dr.gather(mi.UInt32, state.pixels.view, hits.pixel), hits.face)
        channels = mesh.shade(hits.barycentric, mesh.corners(hits.face), colour, facing)
        # Kept for the adjoint: reading the texture again would cost more.
        slopes = [du * (uv.x - uvs[0].x) + dv * (uv.y - uvs[0].y) for uv in uvs[1:]]
        weight = state.weight(hits)
        for total, group in zip(image, GROUPS, strict=True):
            if total is None:
                continue
            values = mi.ArrayXf([weight * channel for channel in channels[group]])
            if state.weights is None:
                dr.scatter(total, values, hits.pixel)
            else:
                dr.scatter_add(total, values, hits.pixel, mode=dr.ReduceMode.NoConflicts)
        # Evaluated here, so that the adjoint does not gather the hits from all pixels again.
        dr.eval(image, slopes, hits.face, hits.b1, hits.b2)
        return slopes

    def _interior_gradients(
        self, state: ForwardState, adjoint: Adjoint, vertices: RowSum, texels: RowSum | None
    ) -> None:
        """Add the gradients of the interior of faces."""
        if adjoint.has_interior:
            for number, hits in enumerate(state.rays):
                if hits.count:
                    interior.backward(state, number, adjoint, vertices, texels)
            mesh = state.mesh
            normals.backward(mesh.faces, mesh.positions, mesh.normals, vertices)

    def _silhouette_gradients(self, state: ForwardState, adjoint: Adjoint, vertices: RowSum) -> None:
        """Add the gradients of silhouettes."""
        if not self._edge_samples:
            return
        self._seed += 1
        silhouette.backward(
            self._scene,
            state,
            self._edges,
            adjoint,
            vertices,
            samples_per_px=self._edge_samples,
            seed=self._seed,
        )

    def _intersection_gradients(self, state: ForwardState, adjoint: Adjoint, vertices: RowSum) -> None:
        """Add the gradients of intersection curves."""
        if self._parts is not None:
            intersection_curves.backward(self._scene, state, self._parts, adjoint, vertices)


class _RenderFunction(torch.autograd.Function):
    """Rendering as an operation of torch. Torch and Dr.Jit share memory, so that every transfer synchronizes."""

    @staticmethod
    def forward(
        ctx: Any, vertices: Tensor, texture: Tensor | None, renderer: Renderer, pixels: Pixels
    ) -> tuple[Tensor, ...]:
        with dr.suspend_grad():
            renderer._update_vertices(vertices)
            state, image = renderer._render(renderer._mesh(vertices, texture), upload(pixels))
        renderer._last = pixels, state
        ctx.renderer, ctx.state = renderer, state
        # The texture is saved because its memory is shared: torch then detects changes before the backward pass.
        ctx.save_for_backward(vertices, *(() if texture is None else (texture,)))
        ctx.set_materialize_grads(False)
        count = len(pixels.view)
        rgb, normal, mask, classes = (
            vertices.new_zeros(3 * count) if values is None else values.torch() for values in image
        )
        return rgb.view(count, 3), normal.view(count, 3), mask, classes.view(count, -1)

    @staticmethod
    def backward(ctx: Any, *grad_outputs: Tensor | None) -> tuple[Tensor | None, ...]:
        renderer: Renderer = ctx.renderer
        state: ForwardState = ctx.state
        mesh = state.mesh
        with dr.suspend_grad():
            vertices, *_ = ctx.saved_tensors
            renderer._update_vertices(vertices)
            adjoint = Adjoint.from_gradients(grad_outputs, mesh)
            vertex_sum = RowSum(mesh.vertex_count, adjoint.unit, columns=8)
            texels = RowSum(mesh.texture_size**2) if ctx.needs_input_grad[1] else None
            renderer._interior_gradients(state, adjoint, vertex_sum, texels)
            if ctx.needs_input_grad[0]:
                renderer._silhouette_gradients(state, adjoint, vertex_sum)
                renderer._intersection_gradients(state, adjoint, vertex_sum)
            position_gradient = _tensor(vertex_sum.table()).view(-1, 8)[:, :3]
            size = mesh.texture_size
            texture_gradient = None if texels is None else _tensor(texels.table()).view(size, size, 4)[..., :3]
        return position_gradient, texture_gradient, None, None


def _flat(tensor: Tensor) -> mi.Float:
    """Return a torch tensor as a flat Dr.Jit array, without a copy where possible."""
    return mi.Float(tensor.detach().contiguous().reshape(-1))


def _tensor(array: mi.Float) -> Tensor:
    dr.eval(array)
    dr.sync_thread()
    return array.torch()


def _ranked_parts(numbers: Int[np.ndarray, "F"]) -> mi.UInt32 | None:
    """Return the rank of each face's part by size, the largest first; None if there is only one part."""
    _, part, sizes = np.unique(numbers, return_inverse=True, return_counts=True)
    rank = (-sizes).argsort(kind="stable").argsort()
    return mi.UInt32(rank[part].astype(np.uint32)) if len(sizes) > 1 else None


def _pixel_offsets(count: int) -> tuple[list[tuple[float, float]], list[tuple[float, float]]]:
    """Return the positions of a pixel's rays, and of further rays if it is partly covered, from its corner (px).

    The centre, or a low-discrepancy (golden ratio) lattice, outermost points first: rays near the four corners rarely
    miss that a pixel is partly covered.
    """
    if count == 1:
        return [_CENTRE], []
    total = max(count, _PARTIAL_RAYS)
    lattice = [((i + 0.5) / total, (i * 0.6180339887498949 + 0.125) % 1) for i in range(total)]
    lattice.sort(key=lambda point: math.dist(point, _CENTRE), reverse=True)
    return lattice[:count], lattice[count:]
