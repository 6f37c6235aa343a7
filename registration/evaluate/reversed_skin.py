"""Audit of skin that is turned inside out: lids or lips that were rolled outwards show cameras their inner side.

Such skin need not fold sharply, lies near the scan and inside no other part: neither distances nor the audits of
intersections and folds notice it.
"""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from jaxtyping import Float

from registration.evaluate.places import fine_places
from registration.frames import MM_PER_M
from registration.geometry.rasterizer import RayCaster
from registration.model import regions
from registration.model.gnm_npz import GNMData
from registration.types import Camera

_WIDTH_PX = 300  # or height, of what is looked at in a view, however large its image is: 0.7 mm a pixel


def reversed_figures(
    vertices: Float[np.ndarray, "V 3"], data: GNMData, cameras: Mapping[str, Camera]
) -> dict[str, Any]:
    """Measure how much of the inner side of the skin of eyes, mouth, nostrils and ears a camera sees (docs/formats.md).

    Args:
        vertices: world, metres, in the model's topology.
        data: the model.
        cameras: of the views.

    Returns:
        The entry of the manifest: of each place that has any, the area across the line of sight in the view that shows
        most of it, and that view; and the sum over the places, None without a camera.
    """
    mesh, triangles = vertices.astype(np.float64), data.triangles.astype(np.int64)
    fine = fine_places(data)
    # (K, F): whether a face belongs to a place
    belongs = np.asarray(np.stack(list(fine.values()))[:, triangles].any(2))
    audited = np.asarray(regions.exterior(data)[triangles].all(1) & belongs.any(0))
    corners = mesh[triangles]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    caster, members = RayCaster(mesh, triangles), mesh[np.unique(triangles[audited])]
    figures: dict[str, Any] = {}
    for view, camera in cameras.items():
        window = _window(camera, members)
        face = caster.rasterize(window)[0]
        face = face[(face >= 0) & audited[face]]
        ray = camera.centre - corners[face, 0]
        inner = (ray * normal[face]).sum(1) < 0
        face, ray = face[inner], ray[inner]
        pixel_mm2 = (ray**2).sum(1) * MM_PER_M**2 / (window.intrinsics[0, 0] * window.intrinsics[1, 1])
        for place, inside in zip(fine, belongs, strict=True):
            area_mm2 = float(pixel_mm2[inside[face]].sum())
            if area_mm2 > figures.get(place, {"area_mm2": 0.0})["area_mm2"]:
                figures[place] = {"area_mm2": area_mm2, "view": view}
    total = float(sum(place["area_mm2"] for place in figures.values()))
    return {"area_mm2": total if cameras else None, "places": figures}


def _window(camera: Camera, points: Float[np.ndarray, "P 3"]) -> Camera:
    """The part of a camera's image that shows some points, as a camera."""
    size = np.array([camera.width_px, camera.height_px])
    xy, depth = camera.project(points)
    if not (depth > 0).all():
        low, high = np.zeros(2), size.astype(float)
    else:
        low, high = np.clip(np.floor(xy.min(0)), 0, size - 1), np.clip(np.ceil(xy.max(0)), 1, size)
    extent = np.maximum(high - low, 1)
    scale = _WIDTH_PX / extent.max()
    intrinsics = camera.intrinsics.copy()
    intrinsics[:2, 2] -= low
    intrinsics[:2] *= scale  # pixel centres have half-integer coordinates
    width, height = np.maximum((extent * scale).astype(int), 1).tolist()
    return replace(camera, width_px=width, height_px=height, intrinsics=intrinsics)
