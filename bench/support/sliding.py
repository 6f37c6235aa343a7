"""Problems of tangential sliding: images and texture of a known mesh, and initial vertices slid along its surface.

The texture is spatial noise with equal statistics on the whole skin; the images are rendered with sixteen rays a pixel.
The initial vertices are on the true surface, one to three millimetres from their true positions.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from registration.fit.optimizer import AdamUniformBlock, minimize
from registration.fit.recipes import Rate
from registration.frames import MM_PER_M
from registration.geometry.closest_point import barycentric_points, closest_points
from registration.geometry.large_steps import LargeSteps
from registration.geometry.rasterizer import visible
from registration.geometry.texels import texels
from registration.geometry.topology import edges, vertex_normals
from registration.losses.uv_ssim import SurfaceTexture, confident_texels
from registration.model.atlas import texture_atlas
from registration.model.gnm import GNM
from registration.model.gnm_npz import GNMData
from registration.model.regions import blush, exterior, group, inner_lips, lids, vertex_classes
from registration.render import backend
from registration.render.renderer import Renderer
from registration.types import Camera, Pixels, Targets

SKIN = np.array([0.45, 0.33, 0.27])  # linear
_FRAME = 1.1  # height of an image over `height_px`
_SLIDE_STEPS = 6
_SURFACE_EVERY = 10  # steps between two searches for the closest points of the true surface

Term = Callable[[Tensor], Tensor]


@dataclass(frozen=True, kw_only=True)
class Problem:
    """Images and texture, the true vertices, and the initial vertices of the fit."""

    triangles: Int[np.ndarray, "F 3"]
    corner_uvs: Float[np.ndarray, "F 3 2"]
    texture: Float[Tensor, "R R 3"]  # the neutral's
    weights: Float[np.ndarray, "V"]
    truth: Float[np.ndarray, "V 3"]
    initial: Float[np.ndarray, "V 3"]
    free: Bool[np.ndarray, "V"]  # the skin; all other vertices are fixed
    evaluated: Bool[np.ndarray, "V"]
    cheek: Float[np.ndarray, "V"]  # weight of the blush
    batch: Targets

    def tangential_mm(self, vertices: Float[np.ndarray, "V 3"]) -> Float[np.ndarray, "M"]:
        """Return the tangential distance of each evaluated vertex from its true position."""
        difference, normals = vertices - self.truth, normals_of(self.truth, self.triangles)
        tangential = difference - (difference * normals).sum(1, keepdims=True) * normals
        return MM_PER_M * np.linalg.norm(tangential, axis=1)[self.evaluated]

    def loss(self, size_px: int, dtype: torch.dtype = torch.float32) -> SurfaceTexture:
        return SurfaceTexture(self.triangles, self.corner_uvs, self.texture.to(dtype), self.weights, size_px)

    def disturbed(self, gain: float, blush: float) -> Targets:
        """Return the images with a gain and a smooth reddish brightening of the cheek."""
        renderer = Renderer(self.triangles, self.corner_uvs, self.cheek[:, None].astype(np.float32))
        rendered = renderer(torch.as_tensor(self.truth, dtype=torch.float32), None, self.batch.pixels)
        brightening = blush * rendered.classes * torch.tensor([1.0, 0.4, 0.4])
        return replace(self.batch, rgb=(gain * self.batch.rgb * (1 + brightening)).clamp(0, 1))


def normals_of(vertices: Float[np.ndarray, "V 3"], triangles: Int[np.ndarray, "F 3"]) -> Float[np.ndarray, "V 3"]:
    return vertex_normals(torch.as_tensor(vertices), torch.as_tensor(triangles.astype(np.int64))).numpy()


def noise(
    points: Float[np.ndarray, "P 3"], wavelengths_mm: tuple[float, float], seed: int, waves: int = 60
) -> Float[np.ndarray, "P"]:
    """Return band-limited spatial noise of variance 1: plane waves in random directions with frequencies in a band."""
    rng = np.random.default_rng(seed)
    direction = rng.standard_normal((waves, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    frequency = MM_PER_M / np.exp(rng.uniform(*np.log(wavelengths_mm), waves))
    phase = (points @ (direction * frequency[:, None]).T + rng.random(waves)) * 2 * np.pi
    return np.cos(phase).sum(1) * np.sqrt(2 / waves)


def camera(centre: np.ndarray, yaw: float, pitch: float, height_m: float, height_px: int) -> Camera:
    """Return a camera at 1 m from the centre, +Y up, that shows `height_m` in `height_px` pixels of a larger image."""
    azimuth, elevation = np.radians([yaw, pitch])
    out = np.array([np.sin(azimuth) * np.cos(elevation), np.sin(elevation), np.cos(azimuth) * np.cos(elevation)])
    right = np.cross([0.0, 1.0, 0.0], out)
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = [right, -np.cross(out, right), -out]
    pose[:3, 3] = -pose[:3, :3] @ (centre + out)
    size, focal = int(_FRAME * height_px), height_px / height_m
    intrinsics = np.array([[focal, 0, 0.48 * size], [0, focal, 0.51 * size], [0, 0, 1]])
    return Camera(width_px=size, height_px=size, intrinsics=intrinsics, T_cam_world=pose)


def noise_texture(
    triangles: np.ndarray,
    corner_uvs: np.ndarray,
    rest: np.ndarray,
    size_px: int,
    *,
    contrast: float,
    wavelengths_mm: tuple[float, float],
) -> Float[Tensor, "R R 3"]:
    """Return a linear texture with noise in the space of the rest vertices, of a contrast relative to the mean."""
    atlas = texels(triangles, corner_uvs, size_px)
    colour = SKIN * (1 + contrast * noise(atlas.interpolate(rest, triangles), wavelengths_mm, seed=1)[:, None])
    return torch.as_tensor(atlas.image(colour, 0.3).clip(0.02, 0.95), dtype=torch.float32)


def render_targets(
    triangles: np.ndarray,
    corner_uvs: np.ndarray,
    vertices: np.ndarray,
    texture: Tensor,
    compared: Float[np.ndarray, "V"],
    cameras: Sequence[Camera],
    pixel_noise: float = 0.0,
) -> Targets:
    """Return all pixels of all views; only pixels that show compared vertices alone have a weight."""
    renderer = Renderer(triangles, corner_uvs, compared[:, None].astype(np.float32), pixel_samples=16)
    pixels = Pixels.full(cameras)
    rendered = renderer(torch.tensor(vertices, dtype=torch.float32), texture, pixels)
    count = len(pixels.view)
    grain = pixel_noise * torch.randn(count, 3, generator=torch.Generator().manual_seed(0))
    none = torch.zeros(count)
    return Targets(
        names=tuple(f"cam{k}" for k in range(len(cameras))),
        class_names=("skin",),
        pixels=pixels,
        rgb=(rendered.rgb + grain).clamp(0, 1),
        rgb_weight=(rendered.classes[:, 0] > 0.99).float(),
        normals=torch.zeros(count, 3),
        normal_weight=none,
        mask=rendered.mask,
        mask_weight=none,
        classes=rendered.classes,
        class_weight=none,
        landmarks={},
        px_per_head=cameras[0].height_px / _FRAME,
    )


def visible_camera_count(
    vertices: np.ndarray, triangles: np.ndarray, cameras: Sequence[Camera]
) -> Int[np.ndarray, "V"]:
    """Return the number of cameras that see each vertex at 60 degrees from its normal or less."""
    total, normals = np.zeros(len(vertices), np.int64), normals_of(vertices, triangles)
    for view in cameras:
        direction = view.centre - vertices
        cosine = (direction * normals).sum(1) / np.linalg.norm(direction, axis=1)
        total += (cosine > 0.5) & visible(vertices, vertices, triangles, view)
    return total


def slide(truth: np.ndarray, triangles: np.ndarray, free: np.ndarray, amount_mm: float) -> Float[np.ndarray, "V 3"]:
    """Return vertices slid smoothly along the surface by this rms length, in small steps projected onto the surface."""
    field = np.stack([noise(truth, (60, 120), seed=seed, waves=20) for seed in (11, 12, 13)], 1)
    normals = normals_of(truth, triangles)
    length = np.sqrt(np.square(field - (field * normals).sum(1, keepdims=True) * normals)[free].sum(1).mean())
    field *= amount_mm / MM_PER_M / length / _SLIDE_STEPS
    faces = triangles[free[triangles].all(1)]
    out = truth.copy()
    for _ in range(_SLIDE_STEPS):
        normals = normals_of(out, triangles)
        step = field - (field * normals).sum(1, keepdims=True) * normals
        _, face, barycentric = closest_points((out + step)[free], truth, faces)
        out[free] = barycentric_points(truth, faces, face, barycentric)
    return out


def head(
    data: GNMData,
    *,
    coefficients: Sequence[float],
    views: Sequence[tuple[float, float]],
    head_px: int,
    texture_px: int,
    slide_mm: float,
    contrast: float = 0.15,
    pixel_noise: float = 0.0,
) -> Problem:
    """Return the problem of an expression of a model's head.

    Args:
        coefficients: of the first expression modes.
        views: yaw and pitch of the cameras, degrees; 0 looks at the face.
        head_px: the head's height in the images.
        contrast: of the texture, in linear light, over its mean.
        pixel_noise: standard deviation, linear.
    """
    backend.activate()
    model, corner_uvs = GNM(data), texture_atlas(data)
    parameters = model.neutral()
    parameters.expression[: len(coefficients)] = torch.tensor(coefficients)
    truth = model(parameters).double().numpy()
    face, outside = group(data, "hockey_mask") > 0.5, exterior(data)
    centre = (truth[face].min(0) + truth[face].max(0)) / 2
    height = 1.6 * float(np.ptp(truth[face, 1]))
    cameras = [camera(centre, *view, height, head_px) for view in views]
    rest, triangles = data.template_vertex_positions, data.triangles
    texture = noise_texture(triangles, corner_uvs, rest, texture_px, contrast=contrast, wavelengths_mm=(5.0, 20.0))
    excluded = vertex_classes(data)[1][:, [1, 2, 6]].sum(1)  # eyes and mouth interior
    evaluated = face & outside & (lids(data) < 0.5) & (inner_lips(data) < 0.5)
    evaluated &= visible_camera_count(truth, triangles, cameras) > 1
    left_cheek = truth[(blush(data) > 0.5) & (rest[:, 0] > 0)].mean(0)
    return Problem(
        triangles=triangles,
        corner_uvs=corner_uvs,
        texture=texture,
        weights=confident_texels(data, np.ones(len(truth))),
        truth=truth,
        initial=slide(truth, triangles, outside, slide_mm),
        free=outside,
        evaluated=evaluated,
        cheek=np.exp(-0.5 * np.square((truth - left_cheek) / 0.025).sum(1)),
        batch=render_targets(triangles, corner_uvs, truth, texture, 1 - excluded, cameras, pixel_noise),
    )


class OnSurface:
    """Mean squared distance from the true surface, mm^2; it does not constrain tangential positions."""

    def __init__(self, problem: Problem):
        self._truth = problem.truth
        self._faces = problem.triangles[problem.free[problem.triangles].all(1)]
        self._free = torch.as_tensor(np.flatnonzero(problem.free))
        self._calls = 0

    def __call__(self, vertices: Tensor) -> Tensor:
        points = vertices.index_select(0, self._free)
        if self._calls % _SURFACE_EVERY == 0:
            _, face, barycentric = closest_points(points.detach().numpy(), self._truth, self._faces)
            a, b, c = (self._truth[self._faces[face, k]] for k in range(3))
            normal = np.cross(b - a, c - a)
            normal /= np.linalg.norm(normal, axis=1, keepdims=True)
            foot = barycentric_points(self._truth, self._faces, face, barycentric)
            self._foot, self._normal = (torch.as_tensor(p, dtype=torch.float32) for p in (foot, normal))
        self._calls += 1
        return (MM_PER_M * ((points - self._foot) * self._normal).sum(1)).square().mean()


def fit(
    problem: Problem,
    terms: Mapping[str, Term],
    initial: Float[np.ndarray, "V 3"],
    stages: Sequence[tuple[int, float, float, float]],
) -> Float[np.ndarray, "V 3"]:
    """Fit the skin's vertices by large steps; stages are steps, smoothing (mm), first and last rate (m)."""
    free = np.flatnonzero(problem.free)
    local = np.cumsum(problem.free) - 1
    skin = local[problem.triangles[problem.free[problem.triangles].all(1)]]
    ends = problem.truth[free][edges(skin).vertices]
    edge_length = float(np.median(np.linalg.norm(ends[:, 0] - ends[:, 1], axis=1)))
    base, index = torch.as_tensor(initial, dtype=torch.float32), torch.as_tensor(free)
    offsets = torch.zeros(len(free), 3)
    for steps, smoothing_mm, first, last in stages:
        large = LargeSteps(
            skin, len(free), edge_length_m=edge_length, smoothing_m=smoothing_mm / MM_PER_M, device=base.device
        )
        latent = large.latent(offsets).requires_grad_()

        def objective(step: int, large: LargeSteps = large, latent: Tensor = latent) -> dict[str, Tensor]:
            vertices = base.index_add(0, index, large.displacement(latent))
            return {name: term(vertices) for name, term in terms.items()}

        _, failure = minimize([AdamUniformBlock(latent, Rate(start=first, end=last))], objective, steps)
        assert failure is None, failure
        offsets = large.displacement(latent).detach()
    return base.index_add(0, index, offsets).double().numpy()
