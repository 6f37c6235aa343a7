"""The fitted mesh drawn over an image: shaded, its outline, and the landmarks."""

from dataclasses import dataclass

import cv2
import numpy as np
import torch
from jaxtyping import Float, Int, UInt8

from registration.doctor.contact_sheet import subpixel
from registration.frames import opencv_intrinsics
from registration.geometry.rasterizer import RayCaster
from registration.geometry.topology import vertex_normals
from registration.types import Camera

Pixels = UInt8[np.ndarray, "_ _ 3"]
OPACITY = 0.75  # of the mesh over the image
_SKIN = np.array([196.0, 205.0, 214.0])  # sRGB
_OUTLINE, _OBSERVED, _FITTED = (0, 214, 190), (255, 214, 60), (235, 40, 80)
_KEY, _FILL = np.array([-0.45, -0.65, -0.61]), np.array([0.8, -0.1, -0.59])  # directions of light, camera's axes
_MARGIN = 0.12  # of a window around the head, relative to its size
_SPECK = 9.0  # px of area: smaller outlines are left out


@dataclass(frozen=True, kw_only=True, eq=False)
class Window:
    """The part of an image around the head, resampled."""

    x: int  # first column and row
    y: int
    width: int
    height: int
    scale: float  # px of the result per px of the image

    def cut(self, pixels: Pixels) -> Pixels:
        """The part of an image; beyond the image it is black."""
        size = round(self.width * self.scale), round(self.height * self.scale)
        matrix = np.array([[1 / self.scale, 0, self.x], [0, 1 / self.scale, self.y]], np.float64)
        matrix[:, 2] += 0.5 / self.scale - 0.5
        source = pixels
        if self.scale < 0.7:  # bilinear samples would miss pixels
            source = cv2.blur(pixels, (max(1, round(1 / self.scale)),) * 2)
        return cv2.warpAffine(source, matrix, size, flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP)

    def camera(self, camera: Camera) -> Camera:
        """The camera of the part."""
        part = camera.cropped(self.x, self.y, self.width, self.height)
        return part.scaled(round(self.width * self.scale), round(self.height * self.scale))


def around(points_px: Float[np.ndarray, "P 2"], side_px: int, margin: float = _MARGIN) -> Window:
    """Return the window around points whose longer side becomes `side_px`."""
    low, high = points_px.min(0), points_px.max(0)
    reach = margin * float((high - low).max())
    x, y = np.floor(low - reach).astype(int)
    width, height = np.maximum(np.ceil(high + reach).astype(int) - (x, y), 2)
    return Window(x=int(x), y=int(y), width=int(width), height=int(height), scale=side_px / max(width, height))


def undistorted(pixels: Pixels, camera: Camera) -> tuple[Pixels, Camera]:
    """Return an image without the camera's distortion, and its camera."""
    if not camera.distortion:
        return pixels, camera
    K = opencv_intrinsics(camera.intrinsics)
    plain = Camera(
        width_px=camera.width_px,
        height_px=camera.height_px,
        intrinsics=camera.intrinsics,
        T_cam_world=camera.T_cam_world,
    )
    return cv2.undistort(pixels, K, np.array(camera.distortion)), plain


def shaded_over(
    pixels: Pixels,
    vertices: Float[np.ndarray, "V 3"],
    triangles: Int[np.ndarray, "F 3"],
    camera: Camera,
    opacity: float = OPACITY,
) -> Pixels:
    """Return an image with the shaded mesh and its outline over it.

    Args:
        pixels: sRGB, of the camera's size.
        vertices: world, metres.
        triangles: of the mesh.
        camera: without distortion.
        opacity: of the mesh, in [0, 1].
    """
    result = pixels.copy()
    xy, depth = camera.project(vertices)
    if not (depth > 0).all():
        return result
    low = np.clip(np.floor(xy.min(0)).astype(int) - 1, 0, [camera.width_px, camera.height_px])
    high = np.clip(np.ceil(xy.max(0)).astype(int) + 1, 0, [camera.width_px, camera.height_px])
    if (high <= low).any():
        return result
    (x, y), (width, height) = low.tolist(), (high - low).tolist()
    face, barycentric = RayCaster(vertices, triangles).rasterize(camera.cropped(x, y, width, height))
    covered = face >= 0
    if not covered.any():
        return result
    corners = triangles[face[covered]]
    normals = vertex_normals(torch.from_numpy(vertices), torch.from_numpy(triangles.astype(np.int64))).numpy()
    normal = np.einsum("pk,pkc->pc", barycentric[covered], normals[corners]) @ camera.T_cam_world[:3, :3].T
    normal /= np.linalg.norm(normal, axis=1, keepdims=True) + 1e-12
    light = 0.42 + 0.45 * np.clip(normal @ _KEY, 0, 1) + 0.18 * np.clip(normal @ _FILL, 0, 1)
    part = result[y : y + height, x : x + width]
    part[covered] = np.clip((1 - opacity) * part[covered] + opacity * _SKIN * light[:, None] + 0.5, 0, 255)
    outlines, _ = cv2.findContours(covered.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    large = [outline for outline in outlines if cv2.contourArea(outline) > _SPECK]
    thickness = max(1, round(max(width, height) / 400))
    window = np.ascontiguousarray(part)
    cv2.drawContours(window, large, -1, _OUTLINE, thickness, cv2.LINE_AA)
    part[:] = window
    return result


def marked(
    pixels: Pixels, observed: Float[np.ndarray, "L 2"], fitted: Float[np.ndarray, "L 2"], window: Window
) -> Pixels:
    """Return a window of an image with the observed landmarks, and lines to the fitted ones.

    Args:
        pixels: sRGB, whole.
        observed: px of the whole image, NaN where not seen.
        fitted: likewise.
        window: that is shown.
    """
    result = window.cut(pixels)
    corner = np.array([window.x, window.y])
    radius = max(1, round(max(result.shape[:2]) / 300))
    for given, found in zip((observed - corner) * window.scale, (fitted - corner) * window.scale, strict=True):
        if not (np.isfinite(given).all() and np.isfinite(found).all()):
            continue
        cv2.line(result, subpixel(*given), subpixel(*found), _FITTED, radius, cv2.LINE_AA, shift=4)
        cv2.circle(result, subpixel(*given), 16 * radius, _OBSERVED, -1, cv2.LINE_AA, shift=4)
    return result
