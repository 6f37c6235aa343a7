"""Maps brought from stereo's own windows onto the pixel grid of a photograph as it is stored, with its distortion."""

import cv2
import numpy as np
from jaxtyping import Bool, Float

from registration.capture.native_writer import ViewArrays
from registration.stereo.depth_map import DepthMap
from registration.types import Camera

_STRIP_PX = 2**20  # stored pixels that are mapped together
_STEP_M = 3e-3  # depths of neighbours that differ by more are not averaged
_BORDER_POINTS = 200  # along each side of the window, to find the stored pixels that it covers
_BACK_PX = 0.05  # error of an inverted distortion beyond which a pixel has no source
_CRITERIA = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 50, 1e-9)


def stored_maps(name: str, camera: Camera, depth_map: DepthMap) -> ViewArrays:
    """Resample a view's maps to its stored photograph.

    Each stored pixel is looked up where its ray meets the window: linearly between four pixels on one surface, else at
    the nearest one.

    Args:
        name: of the view.
        camera: of the stored photograph, with its distortion and full size, at the same pose as the map's.
        depth_map: the maps.

    Returns:
        Arrays that `capture.native_writer.write_channels` writes: depth, normals (camera frame) and confidence.
    """
    shape = (camera.height_px, camera.width_px)
    depth, confidence = np.zeros(shape, np.float32), np.zeros(shape, np.float32)
    normals = np.zeros((*shape, 3), np.float32)
    left, top, right, bottom = _covered(camera, depth_map.camera)
    lines = max(1, _STRIP_PX // max(1, right - left))
    for first in range(top, bottom, lines):
        rows = slice(first, min(first + lines, bottom))
        x, y = _source(camera, depth_map.camera, rows, slice(left, right))
        strip = (rows, slice(left, right))
        depth[strip], normals[strip], confidence[strip] = _sampled(depth_map, x, y)
    return ViewArrays(name=name, camera=camera, rgb=None, depth=depth, normals=normals, confidence=confidence)


def _covered(camera: Camera, window: Camera) -> tuple[int, int, int, int]:
    """First and last column and row of the stored photograph that a window covers."""
    share = np.linspace(0, 1, _BORDER_POINTS)
    side = np.concatenate([np.c_[share, 0 * share], np.c_[share, 0 * share + 1]])
    border = np.concatenate([side, side[:, ::-1]]) * [window.width_px, window.height_px]
    plane = np.c_[border, np.ones(len(border))] @ np.linalg.inv(window.intrinsics).T
    pixels = _distorted(camera, plane)
    size = np.array([camera.width_px, camera.height_px])
    first = np.clip(np.floor(pixels.min(0)) - 2, 0, size).astype(int)
    last = np.clip(np.ceil(pixels.max(0)) + 2, 0, size).astype(int)
    return int(first[0]), int(first[1]), int(last[0]), int(last[1])


def _distorted(camera: Camera, plane: Float[np.ndarray, "P 3"]) -> Float[np.ndarray, "P 2"]:
    coefficients = np.array(camera.distortion) if camera.distortion else None
    pixels = cv2.projectPoints(plane, np.zeros(3), np.zeros(3), camera.intrinsics, coefficients)[0][:, 0]
    return np.nan_to_num(pixels, nan=-1e6, posinf=1e6, neginf=-1e6)


def _source(camera: Camera, window: Camera, rows: slice, columns: slice) -> tuple[np.ndarray, np.ndarray]:
    """Where stored pixels lie in the window, as OpenCV counts pixels; far outside where they have no source."""
    y, x = np.mgrid[rows, columns] + 0.5
    pixels = np.stack([x.ravel(), y.ravel()], -1)
    coefficients = np.array(camera.distortion) if camera.distortion else np.zeros(4)
    plane = cv2.undistortPoints(pixels[:, None], camera.intrinsics, coefficients, criteria=_CRITERIA)[:, 0]
    homogeneous = np.c_[plane, np.ones(len(plane))]
    found = homogeneous @ window.intrinsics[:2].T - 0.5
    if camera.distortion:  # the polynomial of a lens may have no inverse there
        back = np.linalg.norm(_distorted(camera, homogeneous) - pixels, axis=1)
        found[~(back < _BACK_PX)] = -1e4
    across, down = (found[:, k].reshape(x.shape).astype(np.float32) for k in (0, 1))
    return across, down


def _sampled(
    depth_map: DepthMap, x: Float[np.ndarray, "h w"], y: Float[np.ndarray, "h w"]
) -> tuple[Float[np.ndarray, "h w"], Float[np.ndarray, "h w 3"], Float[np.ndarray, "h w"]]:
    known = depth_map.depth > 0
    low = cv2.erode(np.where(known, depth_map.depth, 0).astype(np.float32), np.ones((2, 2), np.uint8), anchor=(0, 0))
    high = cv2.dilate(depth_map.depth.astype(np.float32), np.ones((2, 2), np.uint8), anchor=(0, 0))
    # A corner says whether the four pixels to its right and below are of one surface.
    whole = (low > 0) & (high - low < _STEP_M)
    whole[-1], whole[:, -1] = False, False
    corner_x, corner_y = np.floor(x), np.floor(y)
    smooth: Bool[np.ndarray, "h w"] = _looked_up(whole.astype(np.uint8), corner_x, corner_y, cv2.INTER_NEAREST) > 0

    def take(values: np.ndarray) -> np.ndarray:
        values = values.astype(np.float32)
        nearest = _looked_up(values, x, y, cv2.INTER_NEAREST)
        linear = _looked_up(values, x, y, cv2.INTER_LINEAR)
        return np.where(smooth if values.ndim == 2 else smooth[..., None], linear, nearest)

    depth, normals, confidence = take(depth_map.depth), take(depth_map.normals), take(depth_map.confidence)
    length = np.linalg.norm(normals, axis=-1, keepdims=True)
    normals = np.where(length > 0.1, normals / np.maximum(length, 0.1), 0)
    return depth, normals, np.where(depth > 0, confidence, 0)


def _looked_up(values: np.ndarray, x: np.ndarray, y: np.ndarray, how: int) -> np.ndarray:
    return cv2.remap(values, x, y, how, borderMode=cv2.BORDER_CONSTANT, borderValue=(0, 0, 0, 0))
