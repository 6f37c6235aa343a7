"""Confidence of each vertex: how many views see it, and how well they agree with the mesh there."""

from collections.abc import Iterable

import numpy as np
import torch
from jaxtyping import Float, Int

from registration.geometry.rasterizer import RayCaster
from registration.geometry.topology import vertex_normals
from registration.types import Rendered, Targets

# Errors at which the agreement of a view is one half: of the normal, of the linear colour.
_NORMAL = 2 * np.sin(np.radians(15.0) / 2)  # length of the difference of unit normals
_COLOUR = 0.1


def vertex_confidence(
    vertices: Float[np.ndarray, "V 3"],
    triangles: Int[np.ndarray, "F 3"],
    rendered_views: Iterable[tuple[Targets, Rendered]],
) -> Float[np.ndarray, "V"]:
    """Return a confidence per vertex: agreement times s / (1 + s), in [0, 1).

    s is the sum of cosines of incidence over the views that see a vertex; agreement is their mean, with those weights,
    of 1 / (1 + (normal error / 15 degrees)^2 + (colour error / 0.1)^2) at the vertex' pixel. Pixels that are not
    compared, such as hair, do not count.

    Args:
        vertices: world, metres.
        triangles: of the mesh.
        rendered_views: targets of views in batches, and the mesh rendered there, its colours exposed as the cameras'.
    """
    normals = vertex_normals(torch.as_tensor(vertices), torch.as_tensor(triangles.astype(np.int64))).numpy()
    visible_sum, agreed_sum = np.zeros(len(vertices)), np.zeros(len(vertices))
    mesh = RayCaster(vertices, triangles)
    for targets, rendered in rendered_views:
        agreement, compared = _agreement(targets, rendered)
        for number, camera in enumerate(targets.pixels.cameras):
            rows = np.flatnonzero(mesh.visible(vertices, camera))
            x, y = np.floor(camera.project(vertices[rows].astype(np.float64))[0]).astype(np.int64).T
            x, y = np.minimum(x, camera.width_px - 1), np.minimum(y, camera.height_px - 1)
            pixel = targets.pixels.index[number].cpu().numpy()[y, x]
            valid = (pixel >= 0) & compared[pixel]
            rows, pixel = rows[valid], pixel[valid]
            ray = camera.centre - vertices[rows]
            cosine = np.clip((normals[rows] * ray).sum(1) / np.linalg.norm(ray, axis=1), 0, 1)
            visible_sum[rows] += cosine
            agreed_sum[rows] += cosine * agreement[pixel]
    return (agreed_sum / (1 + visible_sum)).astype(np.float32)


def _agreement(targets: Targets, rendered: Rendered) -> tuple[Float[np.ndarray, "P"], np.ndarray]:
    """Agreement of each pixel, and whether it is compared at all."""
    normal = (rendered.normals - targets.normals).square().sum(-1) / _NORMAL**2 * (targets.normal_weight > 0)
    colour = (rendered.rgb - targets.rgb).square().mean(-1) / _COLOUR**2 * (targets.rgb_weight > 0)
    compared = (targets.normal_weight > 0) | (targets.rgb_weight > 0)
    return (1 / (1 + normal + colour)).cpu().numpy(), compared.cpu().numpy()
