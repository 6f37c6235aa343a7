"""What images, silhouettes and landmarks say about the corrections of cameras: normal equations, view by view.

A camera whose correction is d shows the surface point of pixel x at x + J d. Its image there should be what the mesh
with the texture of all views shows at x, so that every pixel gives linear equations in d [Lucas 1981], with the depth
known from the mesh.
"""

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from registration.fit.cameras import CameraEquations, local_jacobian, projection_jacobian
from registration.losses.image import srgb_encoded
from registration.types import Camera, Rendered, Targets

_PATCH_PX = 100.0  # area over which differences are alike: so many pixels count as one
_HUBER = 1.345  # of robust standard deviations of the differences
_MAD_TO_STD = 1.4826
# Least standard deviations: of encoded colours, components of normals, coverage of a blurred silhouette.
_COLOUR_STD, _NORMAL_STD, _MASK_STD = 0.01, 0.02, 0.1
_BLUR_PX = 1.0  # of silhouettes, which the renderer draws with hard edges
_LANDMARK_STD_PX = 0.3  # least, of a landmark
_LANDMARK_VIEWS = 3  # that locate a landmark; two agree along their rays whatever their cameras are
_LANDMARKS_ALIKE = 4.0  # so many count as one: a detector misplaces neighbours, and points of one contour, together
_RAYLEIGH_MEDIAN = np.sqrt(2 * np.log(2))  # of the length of a vector of two normal components, over their deviation
_ROUNDS = 3  # of reweighted triangulation


def from_images(
    rendered: Rendered, depth_m: Float[Tensor, "P"], targets: Targets, agree: Bool[Tensor, "P"], *, colours: bool
) -> CameraEquations:
    """Return what the pixels of some views say about their cameras.

    Args:
        rendered: the mesh in these cameras, its colours exposed as theirs.
        depth_m: of the mesh along each camera's axis, inf where it is missed.
        targets: of these views; with their weights.
        agree: pixels where both show the same kind of surface.
        colours: whether the texture was estimated, so that colours can be compared.
    """
    count = len(targets.pixels.cameras)
    equations = CameraEquations.zeros(count)
    counts = torch.bincount(targets.pixels.view.long(), minlength=count).tolist()
    first = 0
    for number, pixels in enumerate(counts):
        rows = slice(first, first + pixels)
        first += pixels
        view = _View(number, rows, targets, rendered, depth_m, agree)
        terms = [view.silhouette(), view.surface("normals")]
        terms += [view.surface("rgb")] if colours else []
        for matrix, vector in terms:
            equations.matrix[number] += matrix
            equations.vector[number] += vector
    return equations


class _View:
    """The pixels of one view as images, and its normal equations."""

    def __init__(
        self,
        number: int,
        rows: slice,
        targets: Targets,
        rendered: Rendered,
        depth_m: Float[Tensor, "P"],
        agree: Bool[Tensor, "P"],
    ):
        self._camera = targets.pixels.cameras[number]
        self._index = targets.pixels.index[number]
        self._rows, self._targets, self._rendered, self._agree = rows, targets, rendered, agree
        self._x, self._y = (values[rows].long() for values in (targets.pixels.x, targets.pixels.y))
        self._depth = depth_m[rows]

    def surface(self, channel: str) -> tuple[Float[np.ndarray, "7 7"], Float[np.ndarray, "7"]]:
        """The equations of colours ("rgb") or of normals, inside the surface."""
        ours, theirs = (getattr(source, channel)[self._rows] for source in (self._rendered, self._targets))
        weight = getattr(self._targets, f"{channel.removesuffix('s')}_weight")[self._rows] * self._agree[self._rows]
        if channel == "rgb":
            ours, theirs = srgb_encoded(ours), srgb_encoded(theirs)
        weight = weight * self._neighbours_count(weight > 0) * self._depth.isfinite()
        slope = _slope(self._image(0.5 * (ours + theirs)))[self._y, self._x]  # P C 2
        chosen = (weight > 0).nonzero()[:, 0]
        rows = slope[chosen] @ self._jacobian(chosen, self._depth)
        if channel == "normals":  # of the target: they turn with the camera
            axes = torch.as_tensor(self._camera.T_cam_world[:3, :3], dtype=theirs.dtype, device=theirs.device)
            turn = torch.linalg.cross(theirs[chosen][:, None], axes[None].expand(len(chosen), 3, 3), dim=-1)
            rows[..., :3] += turn.mT
        std = _NORMAL_STD if channel == "normals" else _COLOUR_STD
        return _equations(rows, (ours - theirs)[chosen], weight[chosen], std)

    def silhouette(self) -> tuple[Float[np.ndarray, "7 7"], Float[np.ndarray, "7"]]:
        """The equations of the outline, blurred."""
        weight = self._targets.mask_weight[self._rows]
        ours, theirs = (
            _blurred(self._image(source.mask[self._rows][:, None]), _BLUR_PX)
            for source in (self._rendered, self._targets)
        )
        weight = weight * self._neighbours_count(weight > 0, reach=2)
        slope = _slope(0.5 * (ours + theirs))[self._y, self._x]
        hit = self._depth.isfinite()
        near = self._image(torch.stack([torch.where(hit, self._depth, 0), hit.to(self._depth)], -1))
        near = _box(near, 2)[self._y, self._x]
        depth = near[:, 0] / near[:, 1].clamp_min(1e-6)
        chosen = ((weight > 0) & (near[:, 1] > 0) & (slope[:, 0].norm(dim=-1) > 0.02)).nonzero()[:, 0]
        rows = slope[chosen] @ self._jacobian(chosen, depth)
        difference = (ours - theirs)[self._y, self._x][chosen]
        return _equations(rows, difference, weight[chosen], _MASK_STD)

    def _image(self, values: Float[Tensor, "P D"]) -> Float[Tensor, "H W D"]:
        """The values of this view's pixels as an image, 0 elsewhere."""
        image = values.new_zeros((*self._index.shape, values.shape[-1]))
        image[self._y, self._x] = values
        return image

    def _neighbours_count(self, counts: Bool[Tensor, "P"], reach: int = 1) -> Bool[Tensor, "P"]:
        """Whether all pixels around a pixel count."""
        missing = 1 - self._image(counts.float()[:, None])[..., 0]
        near = torch.nn.functional.max_pool2d(missing[None, None], 2 * reach + 1, stride=1, padding=reach)[0, 0]
        return near[self._y, self._x] == 0

    def _jacobian(self, chosen: Tensor, depth: Float[Tensor, "P"]) -> Float[Tensor, "K 2 7"]:
        """`projection_jacobian` of the surface points of some pixels."""
        z = depth[chosen].double().cpu().numpy()
        x, y = (values[chosen].double().cpu().numpy() + 0.5 for values in (self._x, self._y))
        k = self._camera.intrinsics
        local = np.stack([(x - k[0, 2]) / k[0, 0] * z, (y - k[1, 2]) / k[1, 1] * z, z], -1)
        jacobian = local_jacobian(local, float(k[0, 0]), float(k[1, 1]))
        return torch.as_tensor(jacobian.astype(np.float32), device=depth.device)


def from_landmarks(
    cameras: Sequence[Camera],
    points: Float[np.ndarray, "L 3"],
    detected: Float[np.ndarray, "N L 3"],
    spread_px: Float[np.ndarray, "N L"] | None = None,
) -> CameraEquations:
    """Return what the landmarks of one scheme say about the cameras.

    They are compared with where all views together locate them, not with the mesh, which may be wrong there.

    Args:
        cameras: of all views, without distortion.
        points: where the landmarks are about; world, metres; NaN where that is unknown.
        detected: x_px, y_px and weight in each view; a weight of 0 is no detection.
        spread_px: standard deviation of each detection, NaN where unknown: the differences alone tell.
    """
    equations = CameraEquations.zeros(len(cameras))
    seen = (detected[..., 2] > 0) & np.isfinite(points).all(1)
    seen &= seen.sum(0) >= _LANDMARK_VIEWS
    if not seen.any():
        return equations
    known = seen.any(0)
    seen, detected = seen[:, known], detected[:, known]
    weight = detected[..., 2] * seen
    spread = np.full(seen.shape, _LANDMARK_STD_PX) if spread_px is None else spread_px[:, known]
    spread = np.fmax(spread, _LANDMARK_STD_PX)
    located = points[known]
    for _ in range(_ROUNDS):
        difference = np.stack([c.project(located)[0] for c in cameras]) - detected[..., :2]
        size = np.linalg.norm(difference, axis=-1)
        std = np.maximum(spread, np.median(size[seen]) / _RAYLEIGH_MEDIAN)
        robust = weight * np.minimum(1, _HUBER * std / np.maximum(size, 1e-9)) / (std**2 * _LANDMARKS_ALIKE)
        located = _closest_to_rays(cameras, detected[..., :2], robust)
    for number, camera in enumerate(cameras):
        rows = projection_jacobian(camera, located) * robust[number][:, None, None]
        jacobian = projection_jacobian(camera, located)
        residual = detected[number, :, :2] - camera.project(located)[0]
        equations.matrix[number] = np.einsum("pij,pik->jk", rows, jacobian)
        equations.vector[number] = np.einsum("pij,pi->j", rows, residual)
    return equations


def _closest_to_rays(
    cameras: Sequence[Camera], pixels: Float[np.ndarray, "N L 2"], weight: Float[np.ndarray, "N L"]
) -> Float[np.ndarray, "L 3"]:
    """The points closest to the rays through pixels, with the weights of their image errors (1 / px^2)."""
    matrix, right = np.zeros((pixels.shape[1], 3, 3)), np.zeros((pixels.shape[1], 3))
    for camera, xy, share in zip(cameras, pixels, weight, strict=True):
        k = camera.intrinsics
        rays = np.column_stack([(xy - k[:2, 2]) / k[[0, 1], [0, 1]], np.ones(len(xy))]) @ camera.T_cam_world[:3, :3]
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        across = (np.eye(3) - rays[:, :, None] * rays[:, None, :]) * share[:, None, None]
        matrix += across
        right += across @ camera.centre
    return np.linalg.solve(matrix, right[..., None])[..., 0]


def _equations(
    rows: Float[Tensor, "K C 7"],
    difference: Float[Tensor, "K C"],
    weight: Float[Tensor, "K"],
    least_std: float,
) -> tuple[Float[np.ndarray, "7 7"], Float[np.ndarray, "7"]]:
    """Robust normal equations [Huber 1964]; neighbouring pixels are not independent."""
    if not len(rows):
        return np.zeros((7, 7)), np.zeros(7)
    size = difference.norm(dim=-1)
    std = max(least_std, float(size.median()) * _MAD_TO_STD / np.sqrt(difference.shape[-1]))
    limit = _HUBER * std * np.sqrt(difference.shape[-1])
    scale = weight * (limit / size.clamp_min(1e-9)).clamp_max(1) / (std**2 * _PATCH_PX)
    flat = rows.reshape(-1, 7).double()
    scaled = (rows * scale[:, None, None]).reshape(-1, 7).double()
    vector = scaled.T @ difference.reshape(-1).double()
    return (scaled.T @ flat).cpu().numpy(), vector.cpu().numpy()


def _slope(image: Float[Tensor, "H W C"]) -> Float[Tensor, "H W C 2"]:
    """Central differences, per pixel; 0 at the border."""
    dx, dy = torch.zeros_like(image), torch.zeros_like(image)
    dx[:, 1:-1] = (image[:, 2:] - image[:, :-2]) / 2
    dy[1:-1] = (image[2:] - image[:-2]) / 2
    return torch.stack([dx, dy], -1)


def _blurred(image: Float[Tensor, "H W C"], std_px: float) -> Float[Tensor, "H W C"]:
    """A Gaussian blur, repeating the border."""
    reach = int(np.ceil(3 * std_px))
    kernel = torch.exp(
        -0.5 * (torch.arange(-reach, reach + 1, device=image.device, dtype=image.dtype) / std_px).square()
    )
    return _filtered(image, kernel / kernel.sum(), reach)


def _box(image: Float[Tensor, "H W C"], reach: int) -> Float[Tensor, "H W C"]:
    """The sum over a square around each pixel."""
    return _filtered(image, image.new_ones(2 * reach + 1), reach)


def _filtered(image: Float[Tensor, "H W C"], kernel: Float[Tensor, "S"], reach: int) -> Float[Tensor, "H W C"]:
    planes = torch.nn.functional.pad(image.permute(2, 0, 1)[:, None], (reach, reach, reach, reach), mode="replicate")
    planes = torch.nn.functional.conv2d(planes, kernel.view(1, 1, 1, -1))
    planes = torch.nn.functional.conv2d(planes, kernel.view(1, 1, -1, 1))
    return planes[:, 0].permute(1, 2, 0)
