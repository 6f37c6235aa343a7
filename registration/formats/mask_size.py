"""How large a subject is by its masks: the size of a silhouette at the place where the views' silhouettes meet."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from registration.capture.pixels import read_mask
from registration.doctor.rig_checks import mask_box
from registration.formats.plan import ViewPlan
from registration.formats.undistort import on_plane, undistorted
from registration.types import Camera

_MAX_VIEWS = 8  # whose masks are decoded


def mask_size(plans: Sequence[ViewPlan]) -> float | None:
    """Return the longer side of what masks show, median over the views, in the world's unit.

    None: fewer than two views have masks that are not empty, or their rays do not meet in front of the cameras.

    Raises:
        InputError: a mask cannot be read.
    """
    masked = [plan for plan in plans if plan.view.mask is not None]
    boxes = []
    for plan in masked[:: -(-len(masked) // _MAX_VIEWS)] if masked else []:
        if (corners := _corners(plan)) is not None:
            boxes.append((plan.view.T_cam_world, corners))
    if len(boxes) < 2:
        return None
    poses = np.stack([pose for pose, _ in boxes])
    corners = np.stack([low_high for _, low_high in boxes])  # N 2 2
    middles = corners.mean(1)
    rays = np.concatenate([middles, np.ones((len(boxes), 1))], -1)
    rays = np.einsum("nji,nj->ni", poses[:, :3, :3], rays / np.linalg.norm(rays, axis=-1, keepdims=True))
    centres = -np.einsum("nji,nj->ni", poses[:, :3, :3], poses[:, :3, 3])
    across = np.eye(3) - rays[:, :, None] * rays[:, None]
    point, _, rank, _ = np.linalg.lstsq(across.reshape(-1, 3), np.einsum("nij,nj->ni", across, centres).ravel())
    depths = poses[:, 2, :3] @ point + poses[:, 2, 3]
    if rank < 3 or (depths <= 0).any():
        return None
    return float(np.median((corners[:, 1] - corners[:, 0]).max(-1) * depths))


def _corners(plan: ViewPlan) -> Float[np.ndarray, "2 2"] | None:
    """The undistorted corners, on the plane z = 1, of a mask's box."""
    view = plan.view
    camera = Camera(
        width_px=view.width_px, height_px=view.height_px, intrinsics=view.intrinsics, T_cam_world=view.T_cam_world
    )
    assert view.mask is not None
    box = mask_box(read_mask(view.mask, camera) > 127)
    if box is None:
        return None
    corners = undistorted(view.distortion, on_plane(view.intrinsics, np.stack([box.low, box.high])))
    return corners if np.isfinite(corners).all() else None
