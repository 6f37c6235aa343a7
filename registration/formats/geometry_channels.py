"""Normal maps and depth maps of an import, in the axes and the unit that a native capture takes for granted."""

from pathlib import Path

import numpy as np
from jaxtyping import UInt16

from registration.capture import pixels
from registration.capture.dense_maps import is_colmap_map, read_depth
from registration.formats.plan import ViewPlan
from registration.types import Camera, View

_COLMAP_STEM = ".geometric.bin"


def kept_normals(plan: ViewPlan) -> str | None:
    """Return the suffix with which a view's normal map is copied as it is; None: it must be written anew."""
    file = plan.view.normals
    if file is None or plan.lens is not None or plan.view.normals_frame != "camera_opencv":
        return None
    return _COLMAP_STEM if is_colmap_map(file) else ".png"


def written_normals(plan: ViewPlan) -> UInt16[np.ndarray, "H W 3"]:
    """Return a view's normal map, encoded, through its lens and in the camera's frame (OpenCV's axes).

    Vectors are averaged, not codes. Raises InputError if it cannot be read.
    """
    view = _as_view(plan)
    assert view.normals is not None
    normals = pixels.in_camera(pixels.decode_normals(pixels.read_normals(view.normals, view.camera)), view)
    normals = normals if plan.lens is None else plan.lens.image(normals)
    length = np.linalg.norm(normals, axis=-1, keepdims=True)
    encoded = np.round((normals / np.maximum(length, 1e-6) + 1) / 2 * 65535).astype(np.uint16)
    encoded[length[..., 0] < 0.5] = 0  # background, or across an edge of depth
    return encoded


def write_depth(file: Path, plan: ViewPlan, unit_m: float) -> None:
    """Write a view's depth map, through its lens, as float32 metres.

    Args:
        file: with the suffix `.npy`.
        plan: of the view.
        unit_m: metres per unit of the source's world.

    Raises:
        InputError: it cannot be read.
    """
    view = _as_view(plan)
    depth = read_depth(view) * np.float32(unit_m if view.depth_unit_m is None else 1.0)
    np.save(file, depth if plan.lens is None else plan.lens.labels(depth))


def _as_view(plan: ViewPlan) -> View:
    """The view before undistortion."""
    view = plan.view
    camera = Camera(
        width_px=view.width_px, height_px=view.height_px, intrinsics=view.intrinsics, T_cam_world=view.T_cam_world
    )
    return View(
        name=view.name,
        camera=camera,
        image=view.image if isinstance(view.image, Path) else view.image.file,
        normals=view.normals,
        normals_frame=view.normals_frame,
        depth=view.depth,
        depth_unit_m=view.depth_unit_m,
    )
