"""Corrections of given cameras: six numbers of pose and a focal factor per camera, with a Gaussian prior.

A camera whose calibration is slightly wrong shows the head next to where the other cameras have it. The corrections are
estimated in closed form between the steps of a fit (docs/algorithms.md, "Corrections of cameras"); what the data say
about them is computed in `fit.camera_alignment`.

The rig as a whole stays where it is: a rotation, translation and scale that all cameras share moves no image, and only
moves the head. It is the gauge, and the mean of the corrections along it is held at zero.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float
from scipy.spatial.transform import Rotation
from torch import Tensor

from registration.types import Camera, Targets

# Relative size of each component's expected error: three rotations, three translations, the focal length.
_RELATIVE_SIZE = np.array([1, 1, 1, 1, 1, 1, 0.3])
_MAX_STEP_PX = 2.0  # of one component in one update: alignment by gradients is valid for about a pixel


@dataclass(frozen=True, kw_only=True)
class CameraEquations:
    """What data say about the corrections of N cameras, to second order about the current ones: H d = b."""

    matrix: Float[np.ndarray, "N 7 7"]
    vector: Float[np.ndarray, "N 7"]

    def __add__(self, other: "CameraEquations") -> "CameraEquations":
        return CameraEquations(matrix=self.matrix + other.matrix, vector=self.vector + other.vector)

    @classmethod
    def zeros(cls, cameras: int) -> "CameraEquations":
        """Return equations that say nothing."""
        return cls(matrix=np.zeros((cameras, 7, 7)), vector=np.zeros((cameras, 7)))


class CameraCorrections:
    """The corrections of the cameras of a fit.

    Components of a correction, in this order: rotation about the camera's centre (radians, axes of the camera),
    translation after it (metres, axes of the camera), logarithm of the factor of both focal lengths.

    Args:
        cameras: as given, without distortion; the fit's world.
        points: of the head, world, metres: what errors in pixels are measured on.
        sigma_px: expected rms error of each camera, as the shift of the points in its image (px of `cameras`).
    """

    def __init__(self, cameras: Sequence[Camera], points: Float[np.ndarray, "P 3"], sigma_px: Float[np.ndarray, "N"]):
        self._given, self._points, self._sigma_px = tuple(cameras), points.astype(np.float64), sigma_px
        self.values: Float[np.ndarray, "N 7"] = np.zeros((len(cameras), 7))
        shifts = np.stack([projection_jacobian(camera, self._points) for camera in cameras])  # N P 2 7
        self._metric = np.einsum("npij,npik->njk", shifts, shifts) / len(points)  # px^2
        px_per_unit = np.sqrt(self._metric.diagonal(axis1=1, axis2=2))
        share = _RELATIVE_SIZE / np.linalg.norm(_RELATIVE_SIZE)
        # Independent errors of the components add up to `sigma_px`: their mean squares sum.
        self.std: Float[np.ndarray, "N 7"] = share * sigma_px[:, None] / px_per_unit  # of the prior
        self._px_per_unit = px_per_unit

    def solve(self, equations: CameraEquations, trust: Float[np.ndarray, "N"]) -> None:
        """Take one Gauss-Newton step on data and prior, with the gauge held.

        Args:
            equations: of the data at the current corrections.
            trust: weight of each view in [0, 1]; those of 0 take no part in the mean that is held at zero.
        """
        count, std = len(self._given), self.std.reshape(-1)
        current = self.values.reshape(-1) / std  # in standard deviations of the prior
        system = np.zeros((7 * count, 7 * count))
        for number, matrix in enumerate(equations.matrix):
            block = slice(7 * number, 7 * number + 7)
            system[block, block] = matrix * np.outer(std[block], std[block]) + np.eye(7)
        right = equations.vector.reshape(-1) * std - current
        gauge = self._gauge(trust if trust.any() else np.ones(count)).reshape(7 * count, 7) * std[:, None]
        gauge, _ = np.linalg.qr(gauge / np.linalg.norm(gauge, axis=0))
        kkt = np.block([[system, gauge], [gauge.T, np.zeros((7, 7))]])
        step = np.linalg.lstsq(kkt, np.concatenate([right, -gauge.T @ current]), rcond=None)[0][: 7 * count]
        step = (step * std).reshape(count, 7)
        largest = np.abs(step * self._px_per_unit).max(initial=0.0)
        self.values = self.values + step * min(1.0, _MAX_STEP_PX / max(largest, 1e-12))

    def camera(self, number: int, camera: Camera) -> Camera:
        """Return a camera of the same pose as the given one of that number, with that one's correction.

        Args:
            number: of the view.
            camera: at any size or crop, in any world that is the fit's but for its origin. Its distortion is rescaled,
                so that pixels stay those of the image that was undistorted before.
        """
        value = self.values[number]
        return corrected(camera, value) if value.any() else camera

    def apply(self, targets: Targets) -> Targets:
        """Return targets of all views, of the given cameras, with the corrected cameras.

        Normals of the targets are attached to the camera: they turn with it.
        """
        cameras = tuple(self.camera(number, camera) for number, camera in enumerate(targets.pixels.cameras))
        turns = np.stack(
            [
                after.T_cam_world[:3, :3].T @ before.T_cam_world[:3, :3]
                for before, after in zip(targets.pixels.cameras, cameras, strict=True)
            ]
        )
        return replace(
            targets,
            pixels=replace(targets.pixels, cameras=cameras),
            normals=_turned(targets.normals, targets.pixels.view, turns),
        )

    def shift_px(self) -> Float[np.ndarray, "N"]:
        """Return the rms shift of the head's points in each image by its correction, px of the given cameras."""
        shifts = []
        for number, camera in enumerate(self._given):
            moved = self.camera(number, camera).project(self._points)[0] - camera.project(self._points)[0]
            shifts.append(np.sqrt(np.square(moved).sum(1).mean()))
        return np.array(shifts)

    def sigmas(self) -> Float[np.ndarray, "N"]:
        """Return each camera's shift in standard deviations of the prior."""
        return self.shift_px() / self._sigma_px

    def _gauge(self, trust: Float[np.ndarray, "N"]) -> Float[np.ndarray, "N 7 7"]:
        """Covectors of the corrections, one column each, whose sums over all cameras are held at zero.

        They measure how far the corrections move the head's points in the images as a rotation, translation and scale
        of the world would, by weighted least squares.
        """
        centre = self._points.mean(0)
        columns = np.zeros((len(self._given), 7, 7))
        for column, camera, metric in zip(columns, self._given, self._metric, strict=True):
            rotation = camera.T_cam_world[:3, :3]
            origin = camera.T_cam_world[:3, 3] + rotation @ centre  # the head's centre in the camera's frame
            # The world turns by w about the centre: the camera turns by -R w, and sees the centre where it was.
            column[:3, :3] = -rotation
            column[3:6, :3] = np.cross(rotation.T, origin).T
            column[3:6, 3:6] = -rotation
            column[3:6, 6] = origin  # the world grows about the centre: the camera backs away from it
            column[:] = metric @ column
        return columns * (trust / self._sigma_px**2)[:, None, None]


def corrected(camera: Camera, value: Float[np.ndarray, "7"]) -> Camera:
    """Return a camera with a correction; see `CameraCorrections`."""
    T_cam_world, intrinsics = camera.T_cam_world.copy(), camera.intrinsics.copy()
    T_cam_world[:3] = Rotation.from_rotvec(value[:3]).as_matrix() @ T_cam_world[:3]
    T_cam_world[:3, 3] += value[3:6]
    factor = float(np.exp(value[6]))
    intrinsics[[0, 1], [0, 1]] *= factor
    return replace(
        camera,
        T_cam_world=T_cam_world,
        intrinsics=intrinsics,
        distortion=_rescaled_distortion(camera.distortion, factor),
    )


def projection_jacobian(camera: Camera, points: Float[np.ndarray, "P 3"]) -> Float[np.ndarray, "P 2 7"]:
    """Return how projections change with a correction of the camera, px per component; see `CameraCorrections`.

    Args:
        camera: without distortion.
        points: world, metres, in front of the camera.
    """
    local = points @ camera.T_cam_world[:3, :3].T + camera.T_cam_world[:3, 3]
    return local_jacobian(local, float(camera.intrinsics[0, 0]), float(camera.intrinsics[1, 1]))


def local_jacobian(local: Float[np.ndarray, "P 3"], fx_px: float, fy_px: float) -> Float[np.ndarray, "P 2 7"]:
    """Return `projection_jacobian` of points in the camera's frame, metres."""
    x, y, z = local.T
    a, b = x / z, y / z
    zero, one = np.zeros_like(z), np.ones_like(z)
    rows = (
        np.stack([-a * b, one + a * a, -b, one / z, zero, -a / z, a], -1) * fx_px,
        np.stack([-one - b * b, a * b, a, zero, one / z, -b / z, b], -1) * fy_px,
    )
    return np.stack(rows, 1)


def _rescaled_distortion(distortion: tuple[float, ...], factor: float) -> tuple[float, ...]:
    """OpenCV coefficients for focal lengths times `factor`, that distort every pixel as before.

    A ray x becomes x / factor: coefficients of x^n grow by factor^n.
    """
    powers = (2, 4, 1, 1, 6, 2, 4, 6)  # of k1 k2 p1 p2 k3 k4 k5 k6
    return tuple(float(k * factor**n) for k, n in zip(distortion, powers[: len(distortion)], strict=True))


def _turned(normals: Float[Tensor, "P 3"], view: Tensor, turns: Float[np.ndarray, "N 3 3"]) -> Float[Tensor, "P 3"]:
    """The normals, each turned by the rotation of its view; of the same type."""
    rotations = torch.as_tensor(turns, dtype=torch.float32, device=normals.device)
    counts = torch.bincount(view.long(), minlength=len(turns)).tolist()
    pieces = [part.float() @ rotation.T for part, rotation in zip(normals.split(counts), rotations, strict=True)]
    return torch.cat(pieces).to(normals.dtype)
