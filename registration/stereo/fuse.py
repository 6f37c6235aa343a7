"""One oriented cloud of points from the depth maps of all views."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from registration.stereo.depth_map import DepthMap
from registration.stereo.views import rays

_SPACING_M = 5e-4


@dataclass(frozen=True, kw_only=True, eq=False)
class Cloud:
    """Points on a surface."""

    points: Float[np.ndarray, "P 3"]  # world, metres
    normals: Float[np.ndarray, "P 3"]  # world, unit, outwards


def fuse(maps: Sequence[DepthMap | None], least_confidence: float = 0.3, spacing_m: float = _SPACING_M) -> Cloud:
    """Join depth maps: points of all views, averaged in cells by confidence.

    Args:
        maps: of the views.
        least_confidence: of the pixels that are taken.
        spacing_m: size of the cells.

    Returns:
        The cloud, ordered by cell; there may be no points.
    """
    points, normals, weights = [np.zeros((0, 3))], [np.zeros((0, 3))], [np.zeros(0)]
    for one in maps:
        if one is None:
            continue
        kept = (one.depth > 0) & (one.confidence >= least_confidence) & one.normals.any(-1)
        local = rays(one.camera)[kept] * one.depth[kept][:, None]
        rotation = one.camera.T_cam_world[:3, :3]
        points.append(local.astype(np.float64) @ rotation + one.camera.centre)
        normals.append(one.normals[kept].astype(np.float64) @ rotation)
        weights.append(one.confidence[kept].astype(np.float64))
    point, normal, weight = np.concatenate(points), np.concatenate(normals), np.concatenate(weights)
    if not len(point):
        return Cloud(points=point, normals=normal)
    # Both sides of a thin part, as of an ear, stay apart: cells are divided by the main direction of the normal.
    cell = np.floor((point - point.min(0)) / spacing_m).astype(np.int64)
    axis = np.abs(normal).argmax(1)
    side = 2 * axis + (np.take_along_axis(normal, axis[:, None], 1)[:, 0] > 0)
    size = cell.max(0) + 1
    key = ((cell[:, 0] * size[1] + cell[:, 1]) * size[2] + cell[:, 2]) * 6 + side
    _, index = np.unique(key, return_inverse=True)
    total = np.bincount(index, weight)
    means = [
        np.stack([np.bincount(index, weight * values[:, k]) for k in range(3)], -1) / total[:, None]
        for values in (point, normal)
    ]
    length = np.linalg.norm(means[1], axis=1, keepdims=True)
    return Cloud(points=means[0], normals=means[1] / np.maximum(length, 1e-12))
