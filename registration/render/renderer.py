"""The unshaded differentiable renderer: one wavefront of Dr.Jit over chosen pixels of all views of a step.

Forward casts one ray through each pixel centre. The adjoint has two parts: the interior, recomputed on the hits with
attached vertices (nothing is traced again), and the silhouettes (`silhouette.py`). Nothing else moves an image:
there is no shading, no film and no filter; a pixel is a box.
"""

from __future__ import annotations  # mi.Float exists only once a variant is chosen

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
from registration.render import interior, intersection_curves, normals, silhouette
from registration.render.adjoint import Adjoint, RowSum, unit_of
from registration.render.cameras import PixelList, upload
from registration.render.scene import TriangleScene
from registration.render.shading import GROUPS, NO_FACE, Drawn, Hits, Surface, rows, rows_of_four
from registration.types import Pixels, Rendered

_CENTRE = (0.5, 0.5)
_SILHOUETTE_RAYS = 16  # of an anti-aliased pixel that is partly covered: coverage errs by 0.035 rms, with 4 by 0.1


class Renderer:
    """Draws one topology. Build it once; vertices, texture and cameras change from call to call."""

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
            triangles: of welded vertices; what is not listed is not drawn.
            corner_uvs: in [0, 1]^2 of one atlas; (0, 0) is the texture's lower left corner.
            vertex_classes: soft class shares of the vertices.
            parts: of the mesh that may run through one another, by number; unless told, those that share no vertex.
            pixel_samples: rays per pixel, averaged; 1 is the pixel's centre, which aliases but is enough for a fit. Of
                more, pixels whose rays differ on whether they meet the mesh have at least 16.
            edge_samples: silhouette samples per pixel of projected silhouette length, in the adjoint; 0 leaves
                silhouettes out.
            seed: of those samples; every adjoint draws new ones.

        Raises:
            InputError: the mesh is not a manifold.
        """
        vertex_count, self._class_count = vertex_classes.shape
        self._scene = TriangleScene(vertex_count, triangles)
        self._edges = silhouette.upload(edges(triangles), corner_uvs)
        self._faces = mi.UInt32(rows(triangles.astype(np.uint32)))
        self._corner_uvs = mi.Float(rows(corner_uvs.astype(np.float32).reshape(-1, 6), 8))
        self._classes = mi.Float(rows(vertex_classes.astype(np.float32)))
        self._parts = _parts(connected_parts(triangles) if parts is None else parts)
        self._pixel_offsets, self._finer_offsets = _pixel_offsets(pixel_samples)
        self._edge_samples = edge_samples
        self._seed = seed
        self._last: tuple[Pixels, Drawn] | None = None
        dr.eval(self._faces, self._corner_uvs, self._classes)

    def __call__(
        self, vertices: Float[Tensor, "V 3"], texture: Float[Tensor, "R R 3"] | None, pixels: Pixels
    ) -> Rendered:
        """Draw pixels; differentiable in `vertices` (world, metres) and `texture` (linear).

        Without a texture the RGB channels are zero and cost nothing.
        """
        rgb, normal, mask, classes = _Draw.apply(vertices, texture, self, pixels)
        return Rendered(rgb=rgb, normals=normal, mask=mask, classes=classes)

    def unwrap(
        self,
        vertices: Float[Tensor, "V 3"],
        values: Float[Tensor, "P 3"],
        weights: Float[Tensor, "P"],
        pixels: Pixels,
        texture_size: int,
    ) -> tuple[Float[Tensor, "R R 3"], Float[Tensor, "R R"]]:
        """Carry pixels back to the texture: the transpose of the bilinear look-up.

        Returns the weighted sum of `values` that fell on each texel, and the sum of the weights. Not differentiable.
        """
        with torch.no_grad(), dr.suspend_grad():
            self._move(vertices)
            # A fit looks, then carries back what it saw.
            if self._last is not None and self._last[0] is pixels and len(self._pixel_offsets) == 1:
                hits = self._last[1].hits[0]
            else:
                hits = self._cast(upload(pixels), _CENTRE)
            weighted = torch.cat([values * weights[:, None], weights[:, None]], -1)
            texels = RowSum(texture_size**2, unit_of([weighted]))
            if hits.count:
                surface = self._surface(vertices, None, texture_size)
                footprint = surface.footprint(hits.shares, surface.uvs(hits.face))
                interior.carry_back(texels, footprint, dr.gather(mi.Vector4f, _flat(weighted), hits.pixel))
            image = _tensor(texels.table()).view(texture_size, texture_size, 4)
            return image[..., :3], image[..., 3]

    def _move(self, vertices: Tensor) -> None:
        """Put the vertices here; what was drawn of others is forgotten."""
        if self._scene.update_vertices(vertices):
            self._last = None

    def _surface(self, vertices: Tensor, texture: Tensor | None, texture_size: int = 0) -> Surface:
        positions = rows_of_four(_flat(vertices))
        planes, vertex_normals = normals.planes_and_normals(self._faces, positions)
        return Surface(
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

    def _cast(self, pixels: PixelList, offset: tuple[float, float], which: mi.UInt32 | None = None) -> Hits:
        hit = self._scene.cast_rays(*pixels.rays(offset, which), mi.Bool(True), coherent=True)
        is_hit = hit.is_valid()
        depth, seen = dr.select(is_hit, hit.t, dr.inf), dr.select(is_hit, hit.prim_index, NO_FACE)
        b1, b2 = hit.prim_uv.x, hit.prim_uv.y
        small = None
        if self._parts is not None:
            small = is_hit & (dr.gather(mi.UInt32, self._parts, hit.prim_index, is_hit) != 0)
        dr.eval(is_hit, depth, seen, b1, b2, small)
        lane = dr.compress(is_hit)
        face, b1, b2 = (dr.gather(type(values), values, lane) for values in (seen, b1, b2))
        pixel = lane if which is None else dr.gather(mi.UInt32, which, lane)
        return Hits(offset=offset, seen=seen, depth=depth, pixel=pixel, face=face, b1=b1, b2=b2, small=small)

    def _cast_finer(self, pixels: PixelList, hits: list[Hits]) -> tuple[list[Hits], mi.Float | None]:
        """Further rays where a pixel's first differ on whether they meet the mesh, and the weight of each pixel's rays.

        Adaptive supersampling (Whitted 1980).
        """
        if not self._finer_offsets:
            return [], None if len(hits) == 1 else dr.full(mi.Float, 1 / len(hits), pixels.count)
        nearest, deepest = (functools.reduce(f, (h.depth for h in hits)) for f in (dr.minimum, dr.maximum))
        partly = dr.isfinite(nearest) & ~dr.isfinite(deepest)
        total = len(hits) + len(self._finer_offsets)
        weights = dr.select(partly, mi.Float(1 / total), 1 / len(hits))
        dr.eval(partly, weights)
        which = dr.compress(partly)
        finer = [self._cast(pixels, offset, which) for offset in self._finer_offsets] if dr.width(which) else []
        return finer, weights

    def _draw(self, surface: Surface, pixels: PixelList) -> tuple[Drawn, list[mi.Float | None]]:
        """The drawing, and the groups of channels of all pixels, each flat; no colour without a texture."""
        facing = silhouette.facing(surface, pixels)
        dr.eval(facing)
        hits = [self._cast(pixels, offset) for offset in self._pixel_offsets]
        finer, weights = self._cast_finer(pixels, hits)
        drawn = Drawn(
            surface=surface,
            pixels=pixels,
            facing=facing,
            hits=hits,
            finer=finer,
            weights=weights,
            slopes=[],
        )
        widths = [0 if surface.texture is None else 3, 3, 1, surface.class_count]
        image = [dr.zeros(mi.Float, width * pixels.count) if width else None for width in widths]
        for ray in drawn.rays:
            drawn.slopes.append(self._shade(drawn, ray, image) if ray.count else [])
        dr.sync_thread()
        return drawn, image

    def _shade(self, drawn: Drawn, hits: Hits, image: list[mi.Float | None]) -> list[mi.Vector3f]:
        """Add one ray's share to every pixel; the colours' slopes."""
        surface = drawn.surface
        uvs = surface.uvs(hits.face)
        colour, (du, dv) = surface.colour(hits.shares, uvs)
        facing = drawn.sees_outside(dr.gather(mi.UInt32, drawn.pixels.view, hits.pixel), hits.face)
        channels = surface.shade(hits.shares, surface.corners(hits.face), colour, facing)
        # What drawing knows of the texture: to read it again would cost more.
        slopes = [du * (uv.x - uvs[0].x) + dv * (uv.y - uvs[0].y) for uv in uvs[1:]]
        weight = drawn.weight(hits)
        for total, group in zip(image, GROUPS, strict=True):
            if total is None:
                continue
            values = mi.ArrayXf([weight * channel for channel in channels[group]])
            if drawn.weights is None:
                dr.scatter(total, values, hits.pixel)
            else:
                dr.scatter_add(total, values, hits.pixel, mode=dr.ReduceMode.NoConflicts)
        # The adjoint reads the hits in a row, not gathered from all pixels once more.
        dr.eval(image, slopes, hits.face, hits.b1, hits.b2)
        return slopes

    def _interior_gradients(self, drawn: Drawn, adjoint: Adjoint, vertices: RowSum, texels: RowSum | None) -> None:
        """Add what the inside of the faces gives."""
        if adjoint.moves_inside:
            for number, hits in enumerate(drawn.rays):
                if hits.count:
                    interior.backward(drawn, number, adjoint, vertices, texels)
            surface = drawn.surface
            normals.backward(surface.faces, surface.positions, surface.normals, vertices)

    def _edge_gradients(self, drawn: Drawn, adjoint: Adjoint, vertices: RowSum) -> None:
        """Add what the silhouettes give."""
        if not self._edge_samples:
            return
        self._seed += 1
        silhouette.backward(
            self._scene,
            drawn,
            self._edges,
            adjoint,
            vertices,
            samples_per_px=self._edge_samples,
            seed=self._seed,
        )

    def _crossing_gradients(self, drawn: Drawn, adjoint: Adjoint, vertices: RowSum) -> None:
        """Add what parts that run through one another give."""
        if self._parts is not None:
            intersection_curves.backward(self._scene, drawn, self._parts, adjoint, vertices)


class _Draw(torch.autograd.Function):
    """The bridge: torch tensors in and out, Dr.Jit between. Memory is shared, so every hand-over waits."""

    @staticmethod
    def forward(
        ctx: Any, vertices: Tensor, texture: Tensor | None, renderer: Renderer, pixels: Pixels
    ) -> tuple[Tensor, ...]:
        with dr.suspend_grad():
            renderer._move(vertices)
            drawn, image = renderer._draw(renderer._surface(vertices, texture), upload(pixels))
        renderer._last = pixels, drawn
        ctx.renderer, ctx.drawn = renderer, drawn
        # The texture too: its memory is shared, and torch tells if it was changed meanwhile.
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
        drawn: Drawn = ctx.drawn
        surface = drawn.surface
        with dr.suspend_grad():
            vertices, *_ = ctx.saved_tensors
            renderer._move(vertices)
            adjoint = Adjoint.of(grad_outputs, surface)
            vertex_sum = RowSum(surface.vertex_count, adjoint.unit, columns=8)
            texels = RowSum(surface.texture_size**2) if ctx.needs_input_grad[1] else None
            renderer._interior_gradients(drawn, adjoint, vertex_sum, texels)
            if ctx.needs_input_grad[0]:
                renderer._edge_gradients(drawn, adjoint, vertex_sum)
                renderer._crossing_gradients(drawn, adjoint, vertex_sum)
            position_gradient = _tensor(vertex_sum.table()).view(-1, 8)[:, :3]
            size = surface.texture_size
            texture_gradient = None if texels is None else _tensor(texels.table()).view(size, size, 4)[..., :3]
        return position_gradient, texture_gradient, None, None


def _flat(tensor: Tensor) -> mi.Float:
    """A torch tensor as a flat Dr.Jit array; shares memory where it can."""
    return mi.Float(tensor.detach().contiguous().reshape(-1))


def _tensor(array: mi.Float) -> Tensor:
    dr.eval(array)
    dr.sync_thread()
    return array.torch()


def _parts(numbers: Int[np.ndarray, "F"]) -> mi.UInt32 | None:
    """Numbers in the order of the parts' sizes; None if there is but one part."""
    _, part, sizes = np.unique(numbers, return_inverse=True, return_counts=True)
    rank = (-sizes).argsort(kind="stable").argsort()
    return mi.UInt32(rank[part].astype(np.uint32)) if len(sizes) > 1 else None


def _pixel_offsets(count: int) -> tuple[list[tuple[float, float]], list[tuple[float, float]]]:
    """Where in a pixel its rays go, and where further rays go if it is partly covered.

    The centre, or a low-discrepancy (golden ratio) lattice. Of the lattice the outermost come first: rays near the four
    corners seldom overlook that a pixel is partly covered.
    """
    if count == 1:
        return [_CENTRE], []
    total = max(count, _SILHOUETTE_RAYS)
    lattice = [((i + 0.5) / total, (i * 0.6180339887498949 + 0.125) % 1) for i in range(total)]
    lattice.sort(key=lambda point: math.dist(point, _CENTRE), reverse=True)
    return lattice[:count], lattice[count:]
