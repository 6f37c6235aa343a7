"""The distance of the mesh from depth maps: point to plane, robust (docs/algorithms.md, "Depth term").

Each pixel with a depth has a target on its ray; the point of the mesh on the same ray is drawn towards it along the
mesh's normal. Which point that is follows from the last rendering, so that hidden surfaces take no part.
"""

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from registration.losses.image import subject_pixels
from registration.types import Rendered, SurfaceHits, Targets


def distances(
    vertices: Float[Tensor, "V 3"],
    triangles: Int[Tensor, "F 3"],
    hits: SurfaceHits,
    rendered: Rendered,
    targets: Targets,
) -> Float[Tensor, "H"]:
    """Return the distance of each target from the tangent plane of the mesh, metres; positive: the mesh is in front.

    A mesh's point moves with its face; normal, face and barycentrics are those of the rendering.

    Args:
        vertices: world, metres.
        triangles: of the mesh.
        hits: the mesh's points, all of pixels with a depth.
        rendered: the mesh at all pixels.
        targets: at the same pixels.
    """
    corners = triangles.index_select(0, hits.face)
    points = sum(
        hits.barycentric[:, k, None] * vertices.index_select(0, corners[:, k]) for k in range(3)
    )  # one row per hit
    normals = rendered.normals.detach().index_select(0, hits.pixel)
    return ((points - _target_points(hits, targets)) * normals).sum(-1)


def _target_points(hits: SurfaceHits, targets: Targets) -> Float[Tensor, "H 3"]:
    """The points at the depths of pixels, world."""
    assert targets.depth is not None
    pixels = targets.pixels
    depth = targets.depth.index_select(0, hits.pixel)
    view, x, y = (index.index_select(0, hits.pixel) for index in (pixels.view, pixels.x, pixels.y))
    centres = np.stack([camera.centre for camera in pixels.cameras])
    rays = np.stack([camera.T_cam_world[:3, :3].T @ np.linalg.inv(camera.intrinsics) for camera in pixels.cameras])
    centre, ray = (
        torch.as_tensor(values, dtype=depth.dtype, device=depth.device).index_select(0, view.long())
        for values in (centres, rays)
    )
    position = torch.stack([x + 0.5, y + 0.5, torch.ones_like(depth)], -1)
    return torch.addcmul(centre, (ray @ position[..., None])[..., 0], depth[:, None])


def robust(
    distance: Float[Tensor, "H"], weight: Float[Tensor, "H"], targets: Targets, scale_m: float
) -> Float[Tensor, ""]:
    """Return the sum of w s^2 x^2 / (s^2 + x^2) over the subject's pixels [Geman 1987], m^2.

    Args:
        distance: x, metres.
        weight: w.
        targets: of the step, for the number of the subject's pixels.
        scale_m: s, where the pull is about to fade.
    """
    squared = distance.square()
    return (weight * squared * scale_m**2 / (scale_m**2 + squared)).sum() / subject_pixels(targets)


def compared(
    hits: SurfaceHits, rendered: Rendered, targets: Targets, surfaces: list[int], agree: Bool[Tensor, "P"]
) -> tuple[SurfaceHits, Float[Tensor, "H"]]:
    """Return the hits at pixels with a depth, and their weights: those of the normals there.

    Args:
        hits: of all pixels.
        rendered: the mesh.
        targets: at the same pixels.
        surfaces: classes that take no part: wet eyes and teeth mirror, and stereo is wrong there.
        agree: pixels where rendering and target show the same kind of surface.
    """
    assert targets.depth is not None
    skin = rendered.classes.detach()[:, surfaces].sum(-1) < 0.5
    weight = targets.normal_weight * (targets.depth > 0) * skin * agree
    weight = weight.index_select(0, hits.pixel)
    some = weight.nonzero()[:, 0]
    chosen = SurfaceHits(
        pixel=hits.pixel.index_select(0, some),
        face=hits.face.index_select(0, some),
        barycentric=hits.barycentric.index_select(0, some),
    )
    return chosen, weight.index_select(0, some)
