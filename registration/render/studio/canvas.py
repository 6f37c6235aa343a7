"""The texels of a model's atlas and where they lie on its template: what a painter paints on."""

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
    """T texels of a square texture that are covered by faces."""

    size: int
    texel: Int[np.ndarray, "T"]  # row * size + column; row 0 is at v = 1
    corners: Int[np.ndarray, "T 3"]  # vertices
    weights: Float[np.ndarray, "T 3"]

    def interpolate(self, values: Float[np.ndarray, "V *D"]) -> Float[np.ndarray, "T *D"]:
        """Vertices' values at the covered texels, float32."""
        values = values.astype(np.float32)
        trailing = (1,) * (values.ndim - 1)
        parts = [self.weights[:, k].reshape(-1, *trailing) * values[self.corners[:, k]] for k in range(3)]
        return parts[0] + parts[1] + parts[2]

    def only(self, kept: Bool[np.ndarray, "V"]) -> "Canvas":
        """The texels of the faces whose vertices are all kept."""
        rows = kept[self.corners].all(1)
        return Canvas(size=self.size, texel=self.texel[rows], corners=self.corners[rows], weights=self.weights[rows])


def canvas(data: GNMData, size: int = 2048) -> Canvas:
    """The canvas of a model's texture atlas."""
    uvs = texture_atlas(data).astype(np.float64).reshape(-1, 2)
    # A flat mesh at z = 1 seen by a camera whose pixels are the texels.
    flat = np.column_stack([uvs[:, 0], 1 - uvs[:, 1], np.ones(len(uvs))])
    page = Camera(width_px=size, height_px=size, intrinsics=np.diag([size, size, 1.0]), T_cam_world=np.eye(4))
    face, weights = rasterize(flat, np.arange(len(flat)).reshape(-1, 3), page)
    texel = np.flatnonzero(face.ravel() >= 0)
    return Canvas(
        size=size,
        texel=texel,
        corners=data.triangles[face.ravel()[texel]].astype(np.int64),
        weights=weights.reshape(-1, 3)[texel].astype(np.float32),
    )


def texture_of(size: int, texel: Int[np.ndarray, "T"], colours: Float[np.ndarray, "T 3"]) -> Float[np.ndarray, "R R 3"]:
    """A texture of some texels; the others take the nearest one's colour, so that no look-up meets a gap."""
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


def softened(data: GNMData, values: Float[np.ndarray, "V"], rounds: int) -> Float[np.ndarray, "V"]:
    """Vertices' values averaged with their neighbours', so many times."""
    a, b = edges(data.triangles).vertices.T
    count = np.bincount(a, minlength=len(values)) + np.bincount(b, minlength=len(values))
    for _ in range(rounds):
        total = np.bincount(a, values[b], len(values)) + np.bincount(b, values[a], len(values))
        values = (values + total / np.maximum(count, 1)) / 2
    return values


def soft_group(data: GNMData, name: str, rounds: int = 1) -> Float[np.ndarray, "V"]:
    """A vertex group with softened borders; zero if the model has no such group."""
    if name not in data.vertex_group_names.tolist():
        return np.zeros(len(data.template_vertex_positions))
    return softened(data, group(data, name).astype(np.float64), rounds)


def smoothstep(low: float, high: float, x: Float[np.ndarray, "*N"]) -> Float[np.ndarray, "*N"]:
    """0 below `low`, 1 above `high`, smooth between; the other way round if `low` is the larger."""
    t = np.clip((x - low) / (high - low), 0, 1)
    return t * t * (3 - 2 * t)
