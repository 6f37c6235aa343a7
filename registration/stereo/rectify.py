"""Rectification of two views of a head: rows correspond, and the head's centre has no disparity.

Both images are turned so that their rows run along the baseline (Hartley and Zisserman 2004, section 11.12). Principal
points are then shifted apart so that the head's centre is in the middle of both: what libraries choose shows the head
of two views 25 degrees apart outside the picture.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float

from registration.frames import opencv_intrinsics
from registration.stereo.views import HeadImage
from registration.types import Camera


@dataclass(frozen=True, kw_only=True, eq=False)
class RectifiedPair:
    """Two cameras with parallel axes, whose rows correspond. The left one's points have the larger x."""

    left: Camera
    right: Camera
    focal_px: float
    baseline_m: float
    depth_m: float  # at which the disparity is 0

    def depth_of(self, disparity: Float[np.ndarray, "*S"]) -> Float[np.ndarray, "*S"]:
        """Depths (m, along the common axis) of disparities (px, left x minus right x)."""
        return 1 / (1 / self.depth_m + disparity / (self.focal_px * self.baseline_m))

    def disparity_of(self, depth: Float[np.ndarray, "*S"]) -> Float[np.ndarray, "*S"]:
        """Disparities (px) of depths (m)."""
        return self.focal_px * self.baseline_m * (1 / depth - 1 / self.depth_m)


def rectify(
    first: Camera, second: Camera, centre: Float[np.ndarray, "3"], radius_m: float, size_px: int
) -> tuple[RectifiedPair, bool]:
    """Rectify two pinholes.

    Args:
        first: one camera.
        second: another one, elsewhere.
        centre: of the head, world, metres.
        radius_m: of a sphere around the head.
        size_px: diameter of the sphere in the rectified images, which are wider by the disparities.

    Returns:
        The pair, and whether `first` is its left camera.
    """
    baseline = second.centre - first.centre
    x = baseline / np.linalg.norm(baseline)
    forward = centre - (first.centre + second.centre) / 2
    forward = forward - (forward @ x) * x
    z = forward / np.linalg.norm(forward)
    swapped = first.T_cam_world[0, :3] @ x + second.T_cam_world[0, :3] @ x < 0
    left, right = (second, first) if swapped else (first, second)
    x = -x if swapped else x
    rotation = np.stack([x, np.cross(z, x), z])
    depth = float((centre - left.centre) @ z)
    length = float(np.linalg.norm(baseline))
    focal = size_px / 2 * (depth - radius_m / 2) / radius_m
    most = focal * length * (1 / (depth - radius_m) - 1 / depth)
    width, height = size_px + 2 * int(np.ceil(most)), size_px
    cameras = [_turned(camera, rotation, centre, focal, (width, height)) for camera in (left, right)]
    pair = RectifiedPair(left=cameras[0], right=cameras[1], focal_px=focal, baseline_m=length, depth_m=depth)
    return pair, not swapped


def _turned(
    camera: Camera,
    rotation: Float[np.ndarray, "3 3"],
    centre: Float[np.ndarray, "3"],
    focal: float,
    size: tuple[int, int],
) -> Camera:
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, -rotation @ camera.centre
    local = rotation @ (centre - camera.centre)
    principal = np.array(size) / 2 - focal * local[:2] / local[2]
    intrinsics = np.array([[focal, 0, principal[0]], [0, focal, principal[1]], [0, 0, 1]])
    return Camera(width_px=size[0], height_px=size[1], intrinsics=intrinsics, T_cam_world=pose)


def homography(source: Camera, target: Camera) -> Float[np.ndarray, "3 3"]:
    """Map pixels of one camera to those of another at the same place, both as OpenCV counts them."""
    turn = target.T_cam_world[:3, :3] @ source.T_cam_world[:3, :3].T
    source_k, target_k = opencv_intrinsics(source.intrinsics), opencv_intrinsics(target.intrinsics)
    return np.asarray(target_k @ turn @ np.linalg.inv(source_k))


def turn_image(image: HeadImage, camera: Camera) -> tuple[Float[np.ndarray, "H W"], Float[np.ndarray, "H W"]]:
    """Resample a window for a camera at the same place; returns the grey image and the coverage by the mask."""
    matrix, size = homography(camera, image.camera), (camera.width_px, camera.height_px)
    flags = cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP
    grey = cv2.warpPerspective(image.grey, matrix, size, flags=flags, borderMode=cv2.BORDER_REPLICATE)
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    return grey, cv2.warpPerspective(image.mask.astype(np.float32), matrix, size, flags=flags)
