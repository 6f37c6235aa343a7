"""Planes fitted to depth maps around each pixel: smoother depths, and normals."""

import cv2
import numpy as np
from jaxtyping import Bool, Float

_LEAST_SHARE = 0.3  # of the window's weight that must have depths


def fit_planes(
    depth: Float[np.ndarray, "h w"],
    weight: Float[np.ndarray, "h w"],
    rays: Float[np.ndarray, "h w 3"],
    sigma_px: float,
) -> tuple[Float[np.ndarray, "h w"], Float[np.ndarray, "h w 3"]]:
    """Fit a plane to the depths in a Gaussian window around each pixel, by weighted least squares.

    The inverse depth of a plane is linear in the pixels of a pinhole, so that planes at any slant, also with holes, are
    met exactly: 1 / z = n . ray / d.

    Args:
        depth: along the optical axis, metres; 0 where there is none.
        weight: of the depths, at least 0.
        rays: through the pixel centres with z = 1.
        sigma_px: standard deviation of the window.

    Returns:
        depth: of the planes at the pixels, metres; 0 where the window has too few depths.
        normals: of the planes, unit, towards the camera; 0 there too.
    """
    known = (depth > 0) & (weight > 0)
    if not known.any():
        return np.zeros_like(depth), np.zeros_like(rays)
    w = np.where(known, weight, 0).astype(np.float32)
    scale = float(np.median(depth[known]))
    q = np.where(known, scale / np.where(known, depth, 1) - 1, 0).astype(np.float32)
    height, width = depth.shape
    y, x = (axis.astype(np.float32) for axis in np.mgrid[:height, :width])
    # Moments about each pixel itself: windows are separable, so that they are filters with x and y in the kernel.
    flat, slope, square = _kernels(sigma_px)
    wq = w * q

    def moment(values: np.ndarray, across: np.ndarray, down: np.ndarray) -> np.ndarray:
        return cv2.sepFilter2D(values, cv2.CV_32F, across, down, borderType=cv2.BORDER_CONSTANT)

    m0, mx, my = moment(w, flat, flat), moment(w, slope, flat), moment(w, flat, slope)
    mxx, mxy, myy = moment(w, square, flat), moment(w, slope, slope), moment(w, flat, square)
    q0, qx, qy = moment(wq, flat, flat), moment(wq, slope, flat), moment(wq, flat, slope)
    safe = np.maximum(m0, 1e-6)
    cx, cy, cq = mx / safe, my / safe, q0 / safe
    vxx, vxy, vyy = mxx / safe - cx * cx, mxy / safe - cx * cy, myy / safe - cy * cy
    vxq, vyq = qx / safe - cx * cq, qy / safe - cy * cq
    vxx, vyy = vxx + 1e-3 * sigma_px**2, vyy + 1e-3 * sigma_px**2
    determinant = vxx * vyy - vxy * vxy
    a = (vyy * vxq - vxy * vyq) / np.maximum(determinant, 1e-9)
    b = (vxx * vyq - vxy * vxq) / np.maximum(determinant, 1e-9)
    at = cq - a * cx - b * cy
    share = cv2.GaussianBlur(known.astype(np.float32), (0, 0), sigma_px, borderType=cv2.BORDER_CONSTANT)
    # A window of which the pixel lies at the border extrapolates; where it lies outside it has no say.
    good = (share > _LEAST_SHARE) & (m0 > 1e-6) & (at > -0.9)
    smooth = np.where(good, scale / np.where(good, 1 + at, 1), 0).astype(np.float32)
    return smooth, _normals(a, b, 1 + at, rays, good)


def _normals(
    across: Float[np.ndarray, "h w"],
    down: Float[np.ndarray, "h w"],
    value: Float[np.ndarray, "h w"],
    rays: Float[np.ndarray, "h w 3"],
    good: Bool[np.ndarray, "h w"],
) -> Float[np.ndarray, "h w 3"]:
    """Normals of planes whose inverse depth is `value` here, and changes by `across` and `down` per pixel."""
    step_x = (rays[:, 1:] - rays[:, :-1]).mean((0, 1))  # constant for a pinhole
    step_y = (rays[1:] - rays[:-1]).mean((0, 1))
    # n . step_x = across, n . step_y = down, n . ray = value; both steps have z = 0.
    inverse = np.linalg.inv(np.array([step_x[:2], step_y[:2]], np.float64)).astype(np.float32)
    nx = inverse[0, 0] * across + inverse[0, 1] * down
    ny = inverse[1, 0] * across + inverse[1, 1] * down
    nz = value - nx * rays[..., 0] - ny * rays[..., 1]
    normals = -np.stack([nx, ny, nz], -1)
    length = np.linalg.norm(normals, axis=-1, keepdims=True)
    return np.where(good[..., None], normals / np.maximum(length, 1e-12), 0).astype(np.float32)


def _kernels(sigma: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A Gaussian window, and it times the offset and the squared offset, as correlations."""
    reach = max(1, int(np.ceil(3 * sigma)))
    offset = np.arange(-reach, reach + 1, dtype=np.float32)
    flat = np.exp(-0.5 * (offset / sigma) ** 2)
    flat /= flat.sum()
    return flat, flat * offset, flat * offset**2
