"""Structural dissimilarity in texture space: keeps an expression from sliding along its own skin.

A texel of the neutral's texture names a point of the skin. Where the mesh of the expression puts that point, the images
must show the same: their mean over the views, sampled anew at every step, is compared with the texture. Over windows,
at three scales, the loss is the mean of

    1 - (cov(x, y) + k) / sqrt((var(x) + k) (var(y) + k)),

the structure factor of SSIM [Wang 2004] alone, since the brightness and the colour of skin change, on windows from
which their own blur is subtracted: without that a blush moves vertices twice as far, and with SSIM's contrast factor a
gain of 20 % moves them too.
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn.functional import avg_pool2d, conv2d, interpolate, pad

from registration.geometry.rasterizer import visible
from registration.geometry.texels import SurfacePoints, eroded, single_chart, texels
from registration.geometry.topology import vertex_normals
from registration.losses.image import srgb_encoded
from registration.model.gnm_npz import GNMData
from registration.model.regions import blush, exterior, inner_lips, lids
from registration.types import Camera, Targets

MIN_CONFIDENCE = 0.3  # of a vertex of the neutral, for its texture to be a reference
SCALES = 3  # each at half the resolution of the one before
_BLOCK = 2 ** (SCALES - 1)
_RADIUS, _SIGMA = 5, 1.5  # of the windows, texels of their scale
_MIN_COVERAGE = 0.5  # fraction of a window that must be observed
_MARGIN_PX = 2  # at the boundary of a chart: texels that a resampled texture mixes with those beyond
_NOISE = 1e-4  # k, variance on the perceptual scale; smaller variations do not count
_MIN_COSINE = 0.3  # of incidence
_OCCLUSION_TOLERANCE_M = 1e-3  # a visible point may lie this far behind the mesh
_MAX_MOTION_M = 5e-4  # root mean square over the vertices, after which visibility is determined again
_FADED_REGIONS = ((lids, 0.2), (inner_lips, 0.2), (blush, 0.5))  # and the factor of the weight there
_LUMA = (0.2126, 0.7152, 0.0722)
_CHANNELS = 3  # that are blurred together


@dataclass(frozen=True, kw_only=True)
class _ViewSample:
    """The points that a camera saw when the vertices were these, and their weights."""

    camera: Camera
    vertices: Float[Tensor, "V 3"]
    point: Int[Tensor, "M"]
    weight: Float[Tensor, "M"]


@dataclass(frozen=True, kw_only=True)
class _Scale:
    """The reference at one scale."""

    reference: Float[Tensor, "h w"]
    weight: Float[Tensor, "h w"]  # 0 where nothing is compared


class SurfaceTexture:
    """Dissimilarity of images of a surface and its known texture, at one resolution.

    Args:
        triangles: of the mesh; all of them occlude.
        corner_uvs: of the reference's atlas.
        reference: the known texture, linear.
        weights: of the surroundings of each vertex; where they are 0, nothing is compared.
        size_px: resolution of the comparison, a multiple of 4; texels should be as large as the images' pixels. An
            atlas of 512 texels has 1 mm of skin per texel.

    Raises:
        ValueError: `size_px` is no multiple of 4.
    """

    def __init__(
        self,
        triangles: Int[np.ndarray, "F 3"],
        corner_uvs: Float[np.ndarray, "F 3 2"],
        reference: Float[Tensor, "R R 3"],
        weights: Float[np.ndarray, "V"],
        size_px: int,
    ):
        if size_px % _BLOCK:
            raise ValueError(f"a texture of {size_px} texels does not consist of blocks of {_BLOCK}")
        self._triangles, self._candidates = triangles, weights > 0
        atlas = texels(triangles, corner_uvs, size_px)
        charts = atlas.image(atlas.chart, -1)
        compared = self._candidates[triangles[atlas.face]].all(1)
        compared &= eroded(charts, _MARGIN_PX).ravel()[atlas.index]
        self._corners, self._barycentric = triangles[atlas.face[compared]], atlas.barycentric[compared]
        self._points = SurfacePoints(self._corners, self._barycentric, len(weights), reference)
        # From here on textures are cropped to the texels that are compared.
        row, column = np.divmod(atlas.index[compared], size_px)
        rows, columns = _span(row), _span(column)
        self._shape = rows.stop - rows.start, columns.stop - columns.start
        index = (row - rows.start) * self._shape[1] + column - columns.start
        self._index = torch.as_tensor(index, device=reference.device)
        texel_weights = np.zeros(self._shape)
        texel_weights.ravel()[index] = (self._barycentric * weights[self._corners]).sum(1)
        grey = _grey(_resampled(reference, size_px))[rows, columns]
        self._centre = grey.mean()  # subtracted for the precision of the sums
        self._scales = []
        for scale in range(SCALES):
            one_chart = single_chart(charts, 2**scale * (_RADIUS + 1) - 1)[rows, columns]
            weight = torch.as_tensor(texel_weights * one_chart, device=reference.device).to(reference)
            pooled, weight = (_pooled(image, 2**scale) for image in (grey - self._centre, weight))
            self._scales.append(_Scale(reference=pooled, weight=weight))
        self._windows = _windows(reference)
        self._samples: dict[str, _ViewSample] = {}

    def __call__(self, vertices: Float[Tensor, "V 3"], batch: Targets) -> Float[Tensor, ""]:
        """Return the mean dissimilarity: 0 for equal textures, about 1 for unrelated ones.

        Args:
            vertices: world, metres; differentiable.
            batch: the views of a step, undistorted; its `rgb` without its cameras' gains and biases.
        """
        points = self._points(vertices)
        grey, slope, observed = self._sample_views(points.detach(), vertices.detach(), batch)
        # A texel depends on its own point alone: the images are sampled without autograd, with their derivatives.
        grey = grey + (slope * (points - points.detach())).sum(-1)
        image = grey.new_zeros(self._shape).view(-1).index_copy(0, self._index, grey - self._centre)
        mask = grey.new_zeros(self._shape).view(-1).index_copy(0, self._index, observed.to(grey.dtype))
        return self._compare(image.view(self._shape), mask.view(self._shape))

    def _compare(self, image: Float[Tensor, "h w"], mask: Float[Tensor, "h w"]) -> Float[Tensor, ""]:
        """The mean over the scales."""
        losses = []
        for number, scale in enumerate(self._scales):
            if number:
                image, mask = _pooled(image, 2), (_pooled(mask, 2) == 1).to(mask)
            dissimilarity, coverage = self._dissimilarity(image, scale.reference, mask)
            weight = scale.weight * mask * (coverage > _MIN_COVERAGE)
            losses.append((dissimilarity * weight).sum() / weight.sum().clamp_min(1.0))
        return torch.stack(losses).mean()

    def _dissimilarity(
        self, image: Float[Tensor, "h w"], reference: Float[Tensor, "h w"], mask: Float[Tensor, "h w"]
    ) -> tuple[Float[Tensor, "h w"], Float[Tensor, "h w"]]:
        """1 - structure in the window around each texel, and the fraction of the window that is observed.

        Sums over windows are divided by that fraction.
        """
        coverage, image_mean, reference_mean = self._blur(mask, mask * image, mask * reference)
        coverage = coverage.clamp_min(1e-6)
        image, reference = mask * (image - image_mean / coverage), mask * (reference - reference_mean / coverage)
        ii, rr, ir = (mean / coverage for mean in self._blur(image.square(), reference.square(), image * reference))
        return 1 - (ir + _NOISE) / ((ii + _NOISE) * (rr + _NOISE)).sqrt(), coverage

    def _blur(self, *channels: Float[Tensor, "h w"]) -> tuple[Tensor, ...]:
        """Means of three images over the windows."""
        image = torch.stack(channels)[None].contiguous(memory_format=torch.channels_last)
        across, down = self._windows
        image = conv2d(image, across, padding=(0, _RADIUS), groups=_CHANNELS)
        return conv2d(image, down, padding=(_RADIUS, 0), groups=_CHANNELS)[0].unbind(0)

    @torch.no_grad()
    def _sample_views(
        self, points: Float[Tensor, "K 3"], vertices: Float[Tensor, "V 3"], batch: Targets
    ) -> tuple[Float[Tensor, "K"], Float[Tensor, "K 3"], Bool[Tensor, "K"]]:
        """The mean grey of each point in the images, its derivative in the point, and whether any view shows it."""
        images, points = _images(batch), points.T.contiguous()
        total = points.new_zeros(5, points.shape[1])
        for image, name, camera in zip(images, batch.names, batch.pixels.cameras, strict=True):
            visible_points = self._view_sample(name, camera, vertices)
            sampled = _sample(image, camera, points.index_select(1, visible_points.point))
            sampled[0] *= visible_points.weight
            sampled[1:] *= sampled[0]
            # A camera lists a point at most once, so the order of these sums is fixed.
            total.index_add_(1, visible_points.point, sampled)
        mean = total[1:] / total[0].clamp_min(1e-12)
        return mean[0], mean[1:].T, total[0] > 0

    def _view_sample(self, name: str, camera: Camera, vertices: Float[Tensor, "V 3"]) -> _ViewSample:
        """The points that a camera sees: those of the last call unless the mesh has moved since."""
        last = self._samples.get(name)
        if last is None or last.camera is not camera or _motion(last.vertices, vertices) > _MAX_MOTION_M:
            point, weight = self._visible_points(camera, vertices)
            last = self._samples[name] = _ViewSample(camera=camera, vertices=vertices, point=point, weight=weight)
        return last

    def _visible_points(
        self, camera: Camera, vertices: Float[Tensor, "V 3"]
    ) -> tuple[Int[Tensor, "M"], Float[Tensor, "M"]]:
        """The points that a camera sees; their weights are the squared cosine of incidence times pixels per mm2."""
        faces = torch.as_tensor(self._triangles.astype(np.int64), device=vertices.device)
        normals = vertex_normals(vertices.double(), faces).cpu().numpy()
        positions = vertices.double().cpu().numpy()
        to_camera = camera.centre - positions
        cosine = (normals * to_camera).sum(1) / np.linalg.norm(to_camera, axis=1)
        facing = np.flatnonzero(self._candidates & (cosine > 0))
        # The first face along a ray to a point outside faces the camera: the others need not be tested.
        a, b, c = (positions[self._triangles[:, k]] for k in range(3))
        occluding = (np.cross(b - a, c - a) * to_camera[self._triangles[:, 0]]).sum(1) > 0
        is_visible = np.zeros(len(positions), bool)
        is_visible[facing] = visible(
            positions[facing], positions, self._triangles[occluding], camera, _OCCLUSION_TOLERANCE_M
        )
        point = np.flatnonzero(is_visible[self._corners].all(1))
        incidence = (self._barycentric[point] * cosine[self._corners[point]]).sum(1)
        point, incidence = point[incidence > _MIN_COSINE], incidence[incidence > _MIN_COSINE]
        depth = camera.project(positions)[1][self._corners[point, 0]]
        weight = incidence**2 * camera.intrinsics[0, 0] * camera.intrinsics[1, 1] / depth**2 * 1e-6
        index, weights = (torch.as_tensor(values, device=vertices.device) for values in (point, weight))
        return index, weights.to(vertices)


class UVSSIM(SurfaceTexture):
    """The loss for an expression of a subject whose neutral is registered.

    Args:
        data: the model.
        corner_uvs: of the neutral's atlas.
        reference: the neutral's texture, linear.
        confidence: of the neutral's vertices.
        size_px: resolution of the comparison, a multiple of 4.
    """

    def __init__(
        self,
        data: GNMData,
        corner_uvs: Float[np.ndarray, "F 3 2"],
        reference: Float[Tensor, "R R 3"],
        confidence: Float[np.ndarray, "V"],
        size_px: int,
    ):
        super().__init__(data.triangles, corner_uvs, reference, confident_texels(data, confidence), size_px)


def confident_texels(data: GNMData, confidence: Float[np.ndarray, "V"]) -> Float[np.ndarray, "V"]:
    """Return the weight of the neutral's texture around each vertex, in [0, 1].

    0 except on the exterior, and where the confidence is below `MIN_CONFIDENCE`: the texture is a guess there. Less on
    eyelids, inner lips and cheeks, which fold or change their colour.

    Args:
        data: the model.
        confidence: of the neutral's vertices.
    """
    weights = (exterior(data) & (confidence > MIN_CONFIDENCE)).astype(np.float64)
    for region, factor in _FADED_REGIONS:
        weights *= 1 - (1 - factor) * region(data)
    return weights


def _grey(linear: Float[Tensor, "*S 3"]) -> Float[Tensor, "*S"]:
    return srgb_encoded(linear @ linear.new_tensor(_LUMA))


def _resampled(texture: Float[Tensor, "R R 3"], size_px: int) -> Float[Tensor, "S S 3"]:
    """A texture at another resolution: averaged over areas to shrink it, bilinear to enlarge it."""
    mode = "area" if size_px < len(texture) else "bilinear"
    return interpolate(texture.permute(2, 0, 1)[None], (size_px, size_px), mode=mode)[0].permute(1, 2, 0)


def _span(cells: Int[np.ndarray, "K"]) -> slice:
    """From the first to the last cell, extended to whole blocks of the coarsest scale."""
    low, high = (cells.min(), cells.max()) if len(cells) else (0, 0)
    return slice(int(low // _BLOCK * _BLOCK), int((high // _BLOCK + 1) * _BLOCK))


def _pooled(image: Float[Tensor, "h w"], by: int) -> Float[Tensor, "p q"]:
    return avg_pool2d(image[None], by)[0] if by > 1 else image


def _windows(like: Tensor) -> tuple[Float[Tensor, "C 1 1 S"], Float[Tensor, "C 1 S 1"]]:
    """A Gaussian across and down, for each channel."""
    window = torch.exp(-0.5 * (torch.arange(-_RADIUS, _RADIUS + 1) / _SIGMA).square())
    window = (window / window.sum()).to(like)
    across, down = (window.view(1, 1, *shape).expand(_CHANNELS, -1, -1, -1) for shape in ((1, -1), (-1, 1)))
    # In this layout, of images and windows, a convolution channel by channel is ten times as fast.
    return across.contiguous(memory_format=torch.channels_last), down.contiguous(memory_format=torch.channels_last)


def _motion(before: Float[Tensor, "V 3"], now: Float[Tensor, "V 3"]) -> float:
    return float((now - before).square().sum(-1).mean().sqrt())


def _images(batch: Targets) -> Float[Tensor, "N 2 H W"]:
    """Greys and weights of all pixels as images; 0 where a pixel is not listed."""
    values = torch.stack([_grey(batch.rgb), batch.rgb_weight])
    index = (batch.pixels.index + 1).long()
    return pad(values, (1, 0)).index_select(1, index.view(-1)).view(2, *index.shape).transpose(0, 1)


def _sample(image: Float[Tensor, "2 H W"], camera: Camera, points: Float[Tensor, "3 M"]) -> Float[Tensor, "5 M"]:
    """At the points' projections: a weight, the bilinear grey, and its derivative in the point.

    The weight is the smallest of the four pixels', and 0 outside the image.
    """
    _, height, width = image.shape
    matrix = torch.as_tensor(camera.intrinsics @ camera.T_cam_world[:3], device=points.device).to(points)
    x, y, depth = torch.addmm(matrix[:, 3:], matrix[:, :3], points)
    x, y = x / depth, y / depth
    column, row = (p.sub(0.5).floor().clamp(0, size - 2) for p, size in ((x, width), (y, height)))
    fx, fy = x - 0.5 - column, y - 0.5 - row
    first = (row * width + column).long()
    pixels = image.reshape(2, -1)
    four = [pixels.index_select(1, first + step) for step in (0, 1, width, width + 1)]
    (upper_left, upper_right, lower_left, lower_right), weights = zip(*four, strict=True)
    upper, lower = upper_right - upper_left, lower_right - lower_left
    top, bottom = upper_left + fx * upper, lower_left + fx * lower
    dx, dy = upper + fy * (lower - upper), bottom - top
    out = points.new_empty(5, points.shape[1])
    out[0] = torch.stack(weights).amin(0) * ((fx >= 0) & (fx <= 1) & (fy >= 0) & (fy <= 1))
    out[1] = top + fy * dy
    out[2:] = matrix[:, :3].T @ (torch.stack([dx, dy, -(dx * x + dy * y)]) / depth)
    return out
