"""What keeps an expression from sliding along its own skin: the neutral's texture, looked up in the images.

A texel of the neutral's texture names a point of the skin. Where the mesh of the expression puts that point, the images
must show the same: what they show, averaged over the views and taken anew at every step, is compared with the texture.
Skin changes in brightness and colour, so that only structure counts (of the three factors of SSIM; Wang 2004), and
windows see what is left when their own blur is taken away: under a blush the plain factor moves vertices by twice as
much, and with contrast, the third factor, a gain of 20 % moves them too.
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
from registration.losses.image import encoded
from registration.model.gnm_npz import GNMData
from registration.model.regions import blush, exterior, inner_lips, lids
from registration.types import Camera, Targets

LEAST_CONFIDENCE = 0.3  # of a vertex of the neutral, for its texture to be a reference
SCALES = 3  # each half as fine as the one before
_BLOCK = 2 ** (SCALES - 1)
_RADIUS, _SIGMA = 5, 1.5  # of the windows, texels of their scale
_LEAST_SHARE = 0.5  # of a window that must be known
_MARGIN_PX = 2  # of a chart: texels that a resampled texture mixes with what lies beyond
_NOISE = 1e-4  # variance on the perceptual scale; what varies less is not compared
_LEAST_COSINE = 0.3  # of incidence
_TOLERANCE = 1e-3  # metres by which a point may lie behind the mesh and still be seen
_MOVED = 5e-4  # metres, root mean square over the vertices, after which visibility is asked again
_FADE = ((lids, 0.2), (inner_lips, 0.2), (blush, 0.5))  # what is left of the weight there
_LUMA = (0.2126, 0.7152, 0.0722)
_CHANNELS = 3  # that are blurred together


@dataclass(frozen=True, kw_only=True)
class _Look:
    """Which of the points a camera saw when the vertices were these, and how well."""

    camera: Camera
    vertices: Float[Tensor, "V 3"]
    point: Int[Tensor, "M"]
    weight: Float[Tensor, "M"]


@dataclass(frozen=True, kw_only=True)
class _Scale:
    """What is compared with at one scale."""

    reference: Float[Tensor, "h w"]
    weight: Float[Tensor, "h w"]  # 0 where nothing is compared


class SurfaceTexture:
    """What images show of a surface against its known texture, at one resolution."""

    def __init__(
        self,
        triangles: Int[np.ndarray, "F 3"],
        corner_uvs: Float[np.ndarray, "F 3 2"],
        reference: Float[Tensor, "R R 3"],
        trust: Float[np.ndarray, "V"],
        size_px: int,
    ):
        """
        Args:
            triangles: of the mesh; all of them hide what is behind them.
            corner_uvs: of the reference's atlas.
            reference: the known texture, linear.
            trust: how much a vertex' surroundings count; where it is 0, nothing is compared.
            size_px: at which textures are compared, a multiple of 4. Right are texels as large as the images' pixels:
                an atlas of 512 texels has 1 mm of skin in one.
        """
        if size_px % _BLOCK:
            raise ValueError(f"a texture of {size_px} texels does not consist of blocks of {_BLOCK}")
        self._triangles, self._candidates = triangles, trust > 0
        atlas = texels(triangles, corner_uvs, size_px)
        charts = atlas.image(atlas.chart, -1)
        known = self._candidates[triangles[atlas.face]].all(1)
        known &= eroded(charts, _MARGIN_PX).ravel()[atlas.index]
        self._corners, self._barycentric = triangles[atlas.face[known]], atlas.barycentric[known]
        self._points = SurfacePoints(self._corners, self._barycentric, len(trust), reference)
        # From here on textures are cut to what is known of the reference.
        row, column = np.divmod(atlas.index[known], size_px)
        rows, columns = _span(row), _span(column)
        self._shape = rows.stop - rows.start, columns.stop - columns.start
        place = (row - rows.start) * self._shape[1] + column - columns.start
        self._place = torch.as_tensor(place, device=reference.device)
        weights = np.zeros(self._shape)
        weights.ravel()[place] = (self._barycentric * trust[self._corners]).sum(1)
        grey = _grey(_resampled(reference, size_px))[rows, columns]
        self._centre = grey.mean()  # of no meaning, but good for the sums' precision
        self._scales = []
        for scale in range(SCALES):
            alone = single_chart(charts, 2**scale * (_RADIUS + 1) - 1)[rows, columns]
            weight = torch.as_tensor(weights * alone, device=reference.device).to(reference)
            grey_there, weight = (_pooled(image, 2**scale) for image in (grey - self._centre, weight))
            self._scales.append(_Scale(reference=grey_there, weight=weight))
        self._windows = _windows(reference)
        self._looks: dict[str, _Look] = {}

    def __call__(self, vertices: Float[Tensor, "V 3"], batch: Targets) -> Float[Tensor, ""]:
        """The mean dissimilarity, 0 for equal textures and about 1 for unrelated ones; differentiable in `vertices`.

        `batch` has the views of a step, undistorted; its `rgb` must be free of its cameras' gains and biases.
        """
        points = self._points(vertices)
        shown, slope, known = self._shown(points.detach(), vertices.detach(), batch)
        # Every texel depends on its own point alone, so the images are looked up without recording how.
        shown = shown + (slope * (points - points.detach())).sum(-1)
        image = shown.new_zeros(self._shape).view(-1).index_copy(0, self._place, shown - self._centre)
        mask = shown.new_zeros(self._shape).view(-1).index_copy(0, self._place, known.to(shown.dtype))
        return self._compare(image.view(self._shape), mask.view(self._shape))

    def _compare(self, image: Float[Tensor, "h w"], mask: Float[Tensor, "h w"]) -> Float[Tensor, ""]:
        """The mean over the scales."""
        losses = []
        for number, scale in enumerate(self._scales):
            if number:
                image, mask = _pooled(image, 2), (_pooled(mask, 2) == 1).to(mask)
            dissimilarity, share = self._dissimilarity(image, scale.reference, mask)
            weight = scale.weight * mask * (share > _LEAST_SHARE)
            losses.append((dissimilarity * weight).sum() / weight.sum().clamp_min(1.0))
        return torch.stack(losses).mean()

    def _dissimilarity(
        self, image: Float[Tensor, "h w"], reference: Float[Tensor, "h w"], mask: Float[Tensor, "h w"]
    ) -> tuple[Float[Tensor, "h w"], Float[Tensor, "h w"]]:
        """1 - structure in the window around each texel, and how much of the window is known.

        Windows are cut to what is known: sums over them are divided by their known share.
        """
        share, image_mean, reference_mean = self._blur(mask, mask * image, mask * reference)
        share = share.clamp_min(1e-6)
        image, reference = mask * (image - image_mean / share), mask * (reference - reference_mean / share)
        ii, rr, ir = (mean / share for mean in self._blur(image.square(), reference.square(), image * reference))
        return 1 - (ir + _NOISE) / ((ii + _NOISE) * (rr + _NOISE)).sqrt(), share

    def _blur(self, *channels: Float[Tensor, "h w"]) -> tuple[Tensor, ...]:
        """Means of three images over the windows."""
        image = torch.stack(channels)[None].contiguous(memory_format=torch.channels_last)
        across, down = self._windows
        image = conv2d(image, across, padding=(0, _RADIUS), groups=_CHANNELS)
        return conv2d(image, down, padding=(_RADIUS, 0), groups=_CHANNELS)[0].unbind(0)

    @torch.no_grad()
    def _shown(
        self, points: Float[Tensor, "K 3"], vertices: Float[Tensor, "V 3"], batch: Targets
    ) -> tuple[Float[Tensor, "K"], Float[Tensor, "K 3"], Bool[Tensor, "K"]]:
        """What the images show of the points on average, its slope as a point moves, and whether any shows it."""
        images, points = _images(batch), points.T.contiguous()
        total = points.new_zeros(5, points.shape[1])
        for image, name, camera in zip(images, batch.names, batch.pixels.cameras, strict=True):
            look = self._look(name, camera, vertices)
            sampled = _sample(image, camera, points.index_select(1, look.point))
            sampled[0] *= look.weight
            sampled[1:] *= sampled[0]
            # A camera lists a point at most once, so the order of these sums is fixed.
            total.index_add_(1, look.point, sampled)
        mean = total[1:] / total[0].clamp_min(1e-12)
        return mean[0], mean[1:].T, total[0] > 0

    def _look(self, name: str, camera: Camera, vertices: Float[Tensor, "V 3"]) -> _Look:
        """The last look of a camera, or a new one if the mesh has moved since."""
        last = self._looks.get(name)
        if last is None or last.camera is not camera or _motion(last.vertices, vertices) > _MOVED:
            point, weight = self._seen(camera, vertices)
            last = self._looks[name] = _Look(camera=camera, vertices=vertices, point=point, weight=weight)
        return last

    def _seen(self, camera: Camera, vertices: Float[Tensor, "V 3"]) -> tuple[Int[Tensor, "M"], Float[Tensor, "M"]]:
        """The points that a camera sees, and cosine of incidence squared times pixels per mm2 as their weights."""
        faces = torch.as_tensor(self._triangles.astype(np.int64), device=vertices.device)
        normals = vertex_normals(vertices.double(), faces).cpu().numpy()
        positions = vertices.double().cpu().numpy()
        to_camera = camera.centre - positions
        cosine = (normals * to_camera).sum(1) / np.linalg.norm(to_camera, axis=1)
        asked = np.flatnonzero(self._candidates & (cosine > 0))
        # What hides a point has a side that faces the camera.
        a, b, c = (positions[self._triangles[:, k]] for k in range(3))
        hiding = (np.cross(b - a, c - a) * to_camera[self._triangles[:, 0]]).sum(1) > 0
        seen = np.zeros(len(positions), bool)
        seen[asked] = visible(positions[asked], positions, self._triangles[hiding], camera, _TOLERANCE)
        point = np.flatnonzero(seen[self._corners].all(1))
        own = (self._barycentric[point] * cosine[self._corners[point]]).sum(1)
        point, own = point[own > _LEAST_COSINE], own[own > _LEAST_COSINE]
        depth = camera.project(positions)[1][self._corners[point, 0]]
        weight = own**2 * camera.intrinsics[0, 0] * camera.intrinsics[1, 1] / depth**2 * 1e-6
        index, weights = (torch.as_tensor(values, device=vertices.device) for values in (point, weight))
        return index, weights.to(vertices)


class TextureSlide(SurfaceTexture):
    """The term for an expression of a subject whose neutral is known."""

    def __init__(
        self,
        data: GNMData,
        corner_uvs: Float[np.ndarray, "F 3 2"],
        reference: Float[Tensor, "R R 3"],
        confidence: Float[np.ndarray, "V"],
        size_px: int,
    ):
        """Texture and `confidence` are the neutral's; the rest as for any surface."""
        super().__init__(data.triangles, corner_uvs, reference, trusted(data, confidence), size_px)


def trusted(data: GNMData, confidence: Float[np.ndarray, "V"]) -> Float[np.ndarray, "V"]:
    """How much the neutral's texture tells of each vertex, from 0 to 1.

    Nothing but on the exterior, and where the neutral's `confidence` is low: its texture is a guess there. Less on
    lids, inner lips and cheeks, which fold or change their colour.
    """
    trust = (exterior(data) & (confidence > LEAST_CONFIDENCE)).astype(np.float64)
    for role, left in _FADE:
        trust *= 1 - (1 - left) * role(data)
    return trust


def _grey(linear: Float[Tensor, "*S 3"]) -> Float[Tensor, "*S"]:
    return encoded(linear @ linear.new_tensor(_LUMA))


def _resampled(texture: Float[Tensor, "R R 3"], size_px: int) -> Float[Tensor, "S S 3"]:
    """By area where it shrinks, bilinear where it grows."""
    mode = "area" if size_px < len(texture) else "bilinear"
    return interpolate(texture.permute(2, 0, 1)[None], (size_px, size_px), mode=mode)[0].permute(1, 2, 0)


def _span(cells: Int[np.ndarray, "K"]) -> slice:
    """From the first to the last cell, in whole blocks of the coarsest scale."""
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
    """Greys, and weights, of all pixels; 0 where none is listed."""
    values = torch.stack([_grey(batch.rgb), batch.rgb_weight])
    place = (batch.pixels.index + 1).long()
    return pad(values, (1, 0)).index_select(1, place.view(-1)).view(2, *place.shape).transpose(0, 1)


def _sample(image: Float[Tensor, "2 H W"], camera: Camera, points: Float[Tensor, "3 M"]) -> Float[Tensor, "5 M"]:
    """At the points' projections: a weight, the bilinear grey, and its slope as the point moves.

    The weight is the least of the four pixels', and 0 outside the image.
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
