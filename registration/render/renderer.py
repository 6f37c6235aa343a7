"""The unshaded differentiable renderer: one wavefront of Dr.Jit over chosen pixels of all views of a step.

Forward casts one ray through each pixel centre. The adjoint has two parts: the interior, recomputed on the hits with
attached vertices (nothing is traced again), and the silhouettes (`silhouette.py`). Nothing else moves an image:
there is no shading, no film and no filter; a pixel is a box.
"""

from __future__ import annotations  # mi.Float exists only once a variant is chosen

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from registration.geometry.topology import edges, vertex_normals
from registration.render import silhouette
from registration.render.adjoint import Adjoint, VertexSum
from registration.render.cameras import PixelList, upload
from registration.render.scene import TriangleScene
from registration.render.shading import GROUPS, MASK, Corners, Surface, texel_footprint
from registration.types import Pixels, Rendered

_MISS = 0xFFFFFFFF
_CENTRE = (0.5, 0.5)


class Renderer:
    """Draws one topology. Build it once; vertices, texture and cameras change from call to call."""

    def __init__(
        self,
        triangles: Int[np.ndarray, "F 3"],
        corner_uvs: Float[np.ndarray, "F 3 2"],
        vertex_classes: Float[np.ndarray, "V K"],
        *,
        pixel_samples: int = 1,
        edge_samples: float = 1.0,
        seed: int = 0,
    ):
        """
        Args:
            triangles: of welded vertices; what is not listed is not drawn.
            corner_uvs: in [0, 1]^2 of one atlas; (0, 0) is the texture's lower left corner.
            vertex_classes: soft class shares of the vertices.
            pixel_samples: rays per pixel, averaged; 1 is the pixel's centre, which aliases but is enough for a fit.
            edge_samples: silhouette samples per pixel of projected silhouette length, in the adjoint.
            seed: of those samples; every adjoint draws new ones.

        Raises:
            InputError: the mesh is not a manifold.
        """
        vertex_count, self._class_count = vertex_classes.shape
        self._scene = TriangleScene(vertex_count, triangles)
        self._edges = silhouette.upload(edges(triangles), corner_uvs)
        self._faces = mi.UInt32(triangles.astype(np.uint32).ravel())
        self._corner_uvs = mi.Float(corner_uvs.astype(np.float32).ravel())
        self._classes = mi.Float(vertex_classes.astype(np.float32).ravel())
        self._triangles = torch.as_tensor(triangles.astype(np.int64))
        self._pixel_offsets = _pixel_offsets(pixel_samples)
        self._edge_samples = edge_samples
        self._seed = seed
        self._drawn: Pixels | None = None  # the pixels drawn last, and the faces they met
        self._seen: list[mi.UInt32] = []
        dr.eval(self._faces, self._corner_uvs, self._classes)

    def __call__(
        self, vertices: Float[Tensor, "V 3"], texture: Float[Tensor, "R R 3"] | None, pixels: Pixels
    ) -> Rendered:
        """Draw pixels; differentiable in `vertices` (world, metres) and `texture` (linear).

        Without a texture the RGB channels are zero and cost nothing.
        """
        self._triangles = self._triangles.to(vertices.device)
        normals = vertex_normals(vertices, self._triangles)
        rgb, normal, mask, classes = _Draw.apply(vertices, normals, texture, self, upload(pixels))
        self._drawn = pixels
        return Rendered(rgb=rgb, normals=normal, mask=mask, classes=classes)

    def unwrap(
        self,
        vertices: Float[Tensor, "V 3"],
        values: Float[Tensor, "P D"],
        weights: Float[Tensor, "P"],
        pixels: Pixels,
        texture_size: int,
    ) -> tuple[Float[Tensor, "R R D"], Float[Tensor, "R R"]]:
        """Carry pixels back to the texture: the transpose of the bilinear look-up.

        Returns the weighted sum of `values` that fell on each texel, and the sum of the weights. Not differentiable.
        """
        with torch.no_grad():
            self._triangles = self._triangles.to(vertices.device)
            surface = self._surface(vertices, vertex_normals(vertices, self._triangles), None, texture_size)
            self._move(vertices)
            uploaded = upload(pixels)
            # A fit looks, then carries back what it saw.
            remembered = self._drawn is pixels and len(self._pixel_offsets) == 1
            seen = self._seen[0] if remembered else self._faces_at(uploaded, _CENTRE)
            return self._splat(surface, uploaded, seen, values, weights)

    def _move(self, vertices: Tensor) -> None:
        """Put the vertices here; what was seen of others is forgotten."""
        if self._scene.move(vertices):
            self._drawn = None

    def _surface(self, positions: Tensor, normals: Tensor, texture: Tensor | None, texture_size: int = 0) -> Surface:
        return Surface(
            faces=self._faces,
            corner_uvs=self._corner_uvs,
            classes=self._classes,
            class_count=self._class_count,
            positions=_upload(positions),
            normals=_upload(normals),
            texture=None if texture is None else _upload(texture),
            texture_size=texture_size if texture is None else texture.shape[0],
        )

    def _forward(self, surface: Surface, pixels: PixelList) -> tuple[list[mi.Float], list[mi.UInt32]]:
        """The groups of channels of every pixel, each flat, and for each ray of a pixel the face it meets, or _MISS."""
        image, seen = [mi.Float(0)] * len(GROUPS), []
        with dr.suspend_grad():
            for offset in self._pixel_offsets:
                origin, direction = pixels.rays(offset)
                hit = self._scene.cast(origin, direction, mi.Bool(True), coherent=True)
                is_hit = hit.is_valid()
                face = dr.select(is_hit, hit.prim_index, 0)
                corners = surface.load(face, is_hit)
                channels = surface.shade(corners, hit.prim_uv.x, hit.prim_uv.y, direction, is_hit)
                share = 1 / len(self._pixel_offsets)
                image = [
                    total + share * dr.ravel(mi.ArrayXf(channels[group]))
                    for total, group in zip(image, GROUPS, strict=True)
                ]
                seen.append(dr.select(is_hit, hit.prim_index, _MISS))
                dr.eval(image, seen)
            dr.sync_thread()
        return image, seen

    def _interior(
        self, surface: Surface, pixels: PixelList, offset: tuple[float, float], seen: mi.UInt32, adjoint: Adjoint
    ) -> Corners | None:
        """Fill the gradients of the corners that were hit: the part that needs no visibility change."""
        pixel = dr.compress(seen != _MISS)
        if dr.width(pixel) == 0 or not adjoint.moves_inside:
            return None
        corners = surface.load(dr.gather(mi.UInt32, seen, pixel))
        dr.enable_grad(corners.positions, corners.normals)
        origin, direction = pixels.rays(offset, pixel)
        b1, b2 = corners.barycentrics(origin, direction)
        channels = surface.shade(corners, b1, b2, direction, mi.Bool(True))
        value = adjoint.times(channels, pixel, without=MASK)
        dr.backward(value * (1 / len(self._pixel_offsets)))
        return corners

    def _interior_gradients(
        self, surface: Surface, pixels: PixelList, seen: list[mi.UInt32], adjoint: Adjoint
    ) -> tuple[Tensor, Tensor]:
        """What the inside of the faces gives to positions and normals; the texture's stays with the surface."""
        positions, normals = VertexSum(surface.vertex_count, adjoint), VertexSum(surface.vertex_count, adjoint)
        for offset, faces in zip(self._pixel_offsets, seen, strict=True):
            corners = self._interior(surface, pixels, offset, faces, adjoint)
            if corners is not None:
                for vertex, position, normal in zip(corners.vertices, corners.positions, corners.normals, strict=True):
                    positions.add(vertex, dr.grad(position))
                    normals.add(vertex, dr.grad(normal))
                dr.eval(positions.total, normals.total)
        return positions.tensor(), normals.tensor()

    def _edge_gradients(self, surface: Surface, pixels: PixelList, adjoint: Adjoint) -> Tensor:
        """What the silhouettes give to the gradient of positions."""
        self._seed += 1
        terms = silhouette.backward(
            self._scene, surface, self._edges, pixels, adjoint, samples_per_px=self._edge_samples, seed=self._seed
        )
        positions = VertexSum(surface.vertex_count, adjoint)
        for vertex, gradient in terms:
            positions.add(vertex, gradient)
        return positions.tensor()

    def _faces_at(self, pixels: PixelList, offset: tuple[float, float]) -> mi.UInt32:
        with dr.suspend_grad():
            hit = self._scene.cast(*pixels.rays(offset), mi.Bool(True), coherent=True)
            return dr.select(hit.is_valid(), hit.prim_index, _MISS)

    def _splat(
        self, surface: Surface, pixels: PixelList, seen: mi.UInt32, values: Tensor, weights: Tensor
    ) -> tuple[Tensor, Tensor]:
        size, depth = surface.texture_size, values.shape[-1]
        with dr.suspend_grad():
            weight = _upload(weights)
            active = (seen != _MISS) & (weight > 0)
            corners = surface.load(dr.select(active, seen, 0), active)
            b1, b2 = corners.barycentrics(*pixels.rays(_CENTRE))
            uvs = [dr.gather(mi.Point2f, surface.corner_uvs, 3 * corners.face + k, active) for k in range(3)]
            index, fx, fy = texel_footprint((1 - b1 - b2) * uvs[0] + b1 * uvs[1] + b2 * uvs[2], size)
            shares = [(1 - fx) * (1 - fy), fx * (1 - fy), (1 - fx) * fy, fx * fy]
            shares = [dr.select(active, share * weight, 0) for share in shares]
            index = dr.select(active, index, 0)
            dr.eval(index, shares)
            dr.sync_thread()
        first = index.torch().long()
        total, density = values.new_zeros(size * size, depth), values.new_zeros(size * size)
        for step, share in zip((0, 1, size, size + 1), (share.torch() for share in shares), strict=True):
            density.index_add_(0, first + step, share)
            for k in range(depth):
                total[:, k].index_add_(0, first + step, share * values[:, k])
        return total.view(size, size, depth), density.view(size, size)


class _Draw(torch.autograd.Function):
    """The bridge: torch tensors in and out, Dr.Jit between. Memory is shared, so every hand-over waits."""

    @staticmethod
    def forward(
        ctx: Any, positions: Tensor, normals: Tensor, texture: Tensor | None, renderer: Renderer, pixels: PixelList
    ) -> tuple[Tensor, ...]:
        renderer._move(positions)
        surface = renderer._surface(positions, normals, texture)
        image, ctx.seen = renderer._forward(surface, pixels)
        renderer._seen = ctx.seen
        ctx.renderer, ctx.pixels = renderer, pixels
        ctx.save_for_backward(positions, normals, *(() if texture is None else (texture,)))
        ctx.set_materialize_grads(False)
        normal, mask, classes = (values.torch() for values in image[1:])
        rgb = normal.new_zeros(3 * pixels.count) if texture is None else image[0].torch()
        return rgb.view(-1, 3), normal.view(-1, 3), mask, classes.view(pixels.count, surface.class_count)

    @staticmethod
    def backward(ctx: Any, *grad_outputs: Tensor | None) -> tuple[Tensor | None, ...]:
        positions, normals, *rest = ctx.saved_tensors
        texture = rest[0] if rest else None
        renderer: Renderer = ctx.renderer
        renderer._move(positions)
        surface = renderer._surface(positions, normals, texture)
        adjoint = Adjoint.of(grad_outputs, surface)
        if ctx.needs_input_grad[2]:
            dr.enable_grad(surface.texture)
        position_gradient, normal_gradient = renderer._interior_gradients(surface, ctx.pixels, ctx.seen, adjoint)
        texture_gradient = None
        if texture is not None and ctx.needs_input_grad[2]:
            texture_gradient = dr.grad(surface.texture).torch().reshape(texture.shape).clone()
        if ctx.needs_input_grad[0]:
            surface = renderer._surface(positions, normals, texture)
            position_gradient += renderer._edge_gradients(surface, ctx.pixels, adjoint)
        return position_gradient, normal_gradient, texture_gradient, None, None


def _upload(tensor: Tensor) -> mi.Float:
    """A torch tensor as a flat Dr.Jit array; shares memory where it can."""
    return mi.Float(tensor.detach().contiguous().reshape(-1))


def _pixel_offsets(count: int) -> list[tuple[float, float]]:
    """Where in a pixel its rays go: the centre, or a low-discrepancy (golden ratio) lattice."""
    if count == 1:
        return [_CENTRE]
    return [((i + 0.5) / count, (i * 0.6180339887498949 + 0.25) % 1) for i in range(count)]
