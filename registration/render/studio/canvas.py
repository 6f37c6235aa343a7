"""The texels of a model's atlas as points of its template, for procedural textures."""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int

from registration.geometry.rasterizer import rasterize
from registration.geometry.topology import edges
from registration.model.atlas import texture_atlas
from registration.model.gnm_npz import GNMData
from registration.model.regions import group
from registration.types import Camera


@dataclass(frozen=True, kw_only=True)
class Canvas:
    """The T texels of a square texture that faces cover."""

    size: int
    texel: Int[np.ndarray, "T"]  # row * size + column; row 0 is at v = 1
    corners: Int[np.ndarray, "T 3"]  # vertices of the face
    weights: Float[np.ndarray, "T 3"]  # barycentric

    def interpolate(self, values: Float[np.ndarray, "V *D"]) -> Float[np.ndarray, "T *D"]:
        """Interpolate vertices' values at the covered texels, in float32."""
        values = values.astype(np.float32)
        trailing = (1,) * (values.ndim - 1)
        parts = [self.weights[:, k].reshape(-1, *trailing) * values[self.corners[:, k]] for k in range(3)]
        return parts[0] + parts[1] + parts[2]

    def select(self, kept: Bool[np.ndarray, "V"]) -> "Canvas":
        """Return the texels of the faces whose vertices are all kept."""
        rows = kept[self.corners].all(1)
        return Canvas(size=self.size, texel=self.texel[rows], corners=self.corners[rows], weights=self.weights[rows])


def make_canvas(data: GNMData, size: int = 2048) -> Canvas:
    """Return the canvas of a model's texture atlas.

    Args:
        data: the head model.
        size: side of the texture, texels.
    """
    uvs = texture_atlas(data).astype(np.float64).reshape(-1, 2)
    # The atlas as a mesh in the plane z = 1, rasterized by a camera whose pixels are the texels.
    flat = np.column_stack([uvs[:, 0], 1 - uvs[:, 1], np.ones(len(uvs))])
    camera = Camera(width_px=size, height_px=size, intrinsics=np.diag([size, size, 1.0]), T_cam_world=np.eye(4))
    face, weights = rasterize(flat, np.arange(len(flat)).reshape(-1, 3), camera)
    texel = np.flatnonzero(face.ravel() >= 0)
    return Canvas(
        size=size,
        texel=texel,
        corners=data.triangles[face.ravel()[texel]].astype(np.int64),
        weights=weights.reshape(-1, 3)[texel].astype(np.float32),
    )


def fill_texture(
    size: int, texel: Int[np.ndarray, "T"], colours: Float[np.ndarray, "T 3"]
) -> Float[np.ndarray, "R R 3"]:
    """Return a texture with the colours of some texels; all others take the colour of the nearest one.

    Bilinear look-ups at the border of a chart then meet no gap.

    Args:
        size: R.
        texel: row * size + column of the texels.
        colours: of these texels.
    """
    texture = np.zeros((size * size, 3), np.float32)
    texture[texel] = colours
    empty = np.ones(size * size, np.uint8)
    empty[texel] = 0
    labels = cv2.distanceTransformWithLabels(empty.reshape(size, size), cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL)[
        1
    ].ravel()
    source = np.zeros(int(labels.max()) + 1, np.int64)
    source[labels[texel]] = texel
    return texture[source[labels]].reshape(size, size, 3)


def smoothed(data: GNMData, values: Float[np.ndarray, "V"], iterations: int) -> Float[np.ndarray, "V"]:
    """Average vertices' values repeatedly with the mean of their neighbours."""
    a, b = edges(data.triangles).vertices.T
    count = np.bincount(a, minlength=len(values)) + np.bincount(b, minlength=len(values))
    for _ in range(iterations):
        total = np.bincount(a, values[b], len(values)) + np.bincount(b, values[a], len(values))
        values = (values + total / np.maximum(count, 1)) / 2
    return values


def soft_group(data: GNMData, name: str, iterations: int = 1) -> Float[np.ndarray, "V"]:
    """Return a vertex group with a smoothed border; zero if the model has no such group."""
    if name not in data.vertex_group_names.tolist():
        return np.zeros(len(data.template_vertex_positions))
    return smoothed(data, group(data, name).astype(np.float64), iterations)
