"""The texels of an atlas as points of the surface, and the charts that the atlas is cut into."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy.ndimage import binary_erosion, maximum_filter, minimum_filter
from scipy.sparse import csr_matrix
from torch import Tensor

from registration.geometry.large_steps import to_torch
from registration.geometry.rasterizer import rasterize
from registration.geometry.topology import connected_parts
from registration.types import Camera


@dataclass(frozen=True, kw_only=True)
class Texels:
    """The K texels of a square atlas whose centres lie in a chart. Row 0 is at v = 1."""

    size_px: int
    index: Int[np.ndarray, "K"]  # row * size_px + column, increasing
    face: Int[np.ndarray, "K"]
    barycentric: Float[np.ndarray, "K 3"]
    chart: Int[np.ndarray, "K"]  # number of the chart

    def image(self, values: np.ndarray, background: float) -> np.ndarray:
        """Arrange values of the texels, (K, ...), as an image (R, R, ...), with a value where there is no chart."""
        image = np.full((self.size_px**2, *values.shape[1:]), background, values.dtype)
        image[self.index] = values
        return image.reshape(self.size_px, self.size_px, *values.shape[1:])

    def interpolate(self, values: np.ndarray, triangles: Int[np.ndarray, "F 3"]) -> np.ndarray:
        """Interpolate values of the vertices, (V, ...), at the texels, (K, ...)."""
        return np.einsum("kc,kc...->k...", self.barycentric, values[triangles[self.face]])


def charts(triangles: Int[np.ndarray, "F 3"], corner_uvs: Float[np.ndarray, "F 3 2"]) -> Int[np.ndarray, "F"]:
    """Number the charts of an atlas: triangles are neighbours if they share a vertex with exactly equal uvs."""
    corners = np.column_stack([triangles.ravel(), corner_uvs.reshape(-1, 2)])
    welded = np.unique(corners, axis=0, return_inverse=True)[1]
    return connected_parts(welded.reshape(-1, 3))


def texels(triangles: Int[np.ndarray, "F 3"], corner_uvs: Float[np.ndarray, "F 3 2"], size_px: int) -> Texels:
    """Compute which point of which face each texel's centre shows; where charts overlap, one of them.

    Args:
        triangles: vertex indices.
        corner_uvs: texture coordinates of each face's corners.
        size_px: width and height of the atlas.
    """
    # The atlas is a mesh in the plane z = 1, and this camera sees it as the texture lies.
    intrinsics = np.array([[size_px, 0, 0], [0, -size_px, size_px], [0, 0, 1.0]])
    camera = Camera(width_px=size_px, height_px=size_px, intrinsics=intrinsics, T_cam_world=np.eye(4))
    flat = np.column_stack([corner_uvs.reshape(-1, 2), np.ones(corner_uvs.size // 2)])
    face, barycentric = rasterize(flat, np.arange(len(flat)).reshape(-1, 3), camera)
    index = np.flatnonzero(face.ravel() >= 0)
    face = face.ravel()[index]
    return Texels(
        size_px=size_px,
        index=index,
        face=face,
        barycentric=barycentric.reshape(-1, 3)[index],
        chart=charts(triangles, corner_uvs)[face],
    )


def eroded(labels: Int[np.ndarray, "H W"], by_px: int) -> Bool[np.ndarray, "H W"]:
    """Select the texels whose square neighbourhood, `by_px` to every side, belongs to one chart entirely (-1: none)."""
    inside = _alike(labels, by_px)
    return inside & binary_erosion(labels >= 0, np.ones((2 * by_px + 1, 2 * by_px + 1)))


def single_chart(labels: Int[np.ndarray, "H W"], within_px: int) -> Bool[np.ndarray, "H W"]:
    """Select the texels in whose square neighbourhood there is no second chart; there may be gaps (-1)."""
    return (labels >= 0) & _alike(labels, within_px)


def _alike(labels: Int[np.ndarray, "H W"], within_px: int) -> Bool[np.ndarray, "H W"]:
    size = 2 * within_px + 1
    beyond = labels.max(initial=0) + 1
    least = minimum_filter(np.where(labels < 0, beyond, labels), size, mode="nearest")
    return least == maximum_filter(labels, size, mode="nearest")


class SurfacePoints:
    """K fixed points on a mesh's faces as a sparse linear function of its V vertices."""

    def __init__(
        self, corners: Int[np.ndarray, "K 3"], barycentric: Float[np.ndarray, "K 3"], vertex_count: int, like: Tensor
    ):
        """`corners` are the vertices of each point's face; `like` has the type and the device."""
        rows = np.arange(0, 3 * len(corners) + 1, 3)
        matrix = csr_matrix((barycentric.ravel(), corners.ravel(), rows), (len(corners), vertex_count))
        self._matrix, self._transposed = (to_torch(m, like.device, like.dtype) for m in (matrix, matrix.T.tocsr()))

    def __call__(self, vertices: Float[Tensor, "V 3"]) -> Float[Tensor, "K 3"]:
        """Compute the points; differentiable, and deterministic on a CPU."""
        return _Product.apply(vertices, self._matrix, self._transposed)


class _Product(torch.autograd.Function):
    """A product with a stored transpose: PyTorch's own adjoint transposes in every call, ten times as slow."""

    @staticmethod
    def forward(ctx: Any, vertices: Tensor, matrix: Tensor, transposed: Tensor) -> Tensor:
        ctx.transposed = transposed
        return matrix @ vertices

    @staticmethod
    def backward(ctx: Any, *grad_outputs: Tensor) -> tuple[Tensor, None, None]:
        return ctx.transposed @ grad_outputs[0], None, None
