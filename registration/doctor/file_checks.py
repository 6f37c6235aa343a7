"""Checks of cameras and files one by one, without decoding any."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from registration.capture import headers, label_maps
from registration.capture.dense_maps import is_colmap_map, read_colmap_map, read_depth
from registration.doctor.findings import refuse
from registration.types import Capture, View

# Field of a view -> what messages call its file.
ROLES: Mapping[str, str] = MappingProxyType(
    {
        "image": "image",
        "mask": "mask",
        "normals": "normal map",
        "confidence": "confidence map",
        "segmentation": "label map",
    }
)


def without(view: View, field: str) -> View:
    """The view without one of its files, or landmarks."""
    if field == "landmarks":
        return replace(view, landmarks={}, landmark_spread_px={})
    nothing: dict[str, Any] = {field: None}
    return replace(view, **nothing)


def check_count(capture: Capture) -> None:
    """Refuse a capture of fewer than two views. Raises InputError."""
    if len(capture.views) < 2:
        raise refuse(
            "views",
            "There are too few views",
            where=capture.root,
            expected="at least 2 views",
            got=len(capture.views),
            fix="add calibrated images; in images.txt of COLMAP every image takes two lines, the second may be empty",
        )


def check_camera(capture: Capture, view: View) -> None:
    camera = view.camera
    K, rotation = camera.intrinsics, camera.T_cam_world[:3, :3]
    if not (np.isfinite(K).all() and np.isfinite(camera.distortion).all() and K[0, 0] > 0 and K[1, 1] > 0):
        raise refuse(
            "camera",
            "The intrinsics are singular or not finite",
            where=f"{capture.root}: view {view.name}",
            expected="finite numbers, focal lengths > 0",
            got=np.array2string(K),
            fix="calibrate the camera again",
        )
    rigid = np.isfinite(camera.T_cam_world).all() and np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-4)
    if not (rigid and np.linalg.det(rotation) > 0):
        raise refuse(
            "camera",
            "The pose is singular or not finite",
            where=f"{capture.root}: view {view.name}",
            expected="a rotation and a finite translation",
            got=np.array2string(camera.T_cam_world),
            fix="calibrate the camera again, or remove its view",
        )


def check_headers(capture: Capture, view: View) -> None:
    """Refuse a view with a file that is missing, truncated, or of another size than the camera's. Raises InputError."""
    for field, role in ROLES.items():
        path = getattr(view, field)
        if path is not None and is_colmap_map(path):
            read_colmap_map(path, role, view.camera, 3)
        elif path is not None:
            _check_header(path, role, view)
    if view.depth is not None:
        read_depth(view)
    if view.segmentation is not None and not capture.classes:
        fits = label_maps.fitting_tables(capture.views)
        looks = f'the maps look like those of {" or ".join(fits)}: write table = "{fits[0]}"' if fits else ""
        raise refuse(
            "labels-vocabulary",
            "The label maps have no class names",
            where=capture.root / "capture.toml",
            expected='[segmentation] classes = ["background", ...], or table = "..."',
            got="nothing",
            fix=looks or "name every label index, or the table of the program that wrote the maps",
        )


def _check_header(path: Path, role: str, view: View) -> None:
    header = headers.require_size(path, role, view.camera.width_px, view.camera.height_px)
    headers.require_complete(path, role)
    if role == "normal map" and header.png_bits != 16:
        raise refuse(
            "normals-encoding",
            "The normal map has too few bits",
            where=path,
            expected="16 bit RGB PNG, n = 2 v / 65535 - 1",
            got="no PNG" if header.png_bits is None else f"{header.png_bits} bits",
            fix="write it with 16 bits",
        )
