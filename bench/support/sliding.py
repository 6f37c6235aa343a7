"""Surfaces whose skin has slid: images and texture of a known mesh, and the same mesh slid along its own surface.

The texture is noise in space, alike everywhere on the skin; the images are the renderer's, with sixteen rays a pixel.
What is to be put right lies on the true surface, every vertex one to three millimetres from its place.
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
_FRAME = 1.1  # an image's height over what it shows
_SLIDE_STEPS = 6
_SURFACE_EVERY = 10  # steps between two searches for the closest points of the true surface

Term = Callable[[Tensor], Tensor]


@dataclass(frozen=True, kw_only=True)
class Problem:
    """What is known, and where the search begins."""

    triangles: Int[np.ndarray, "F 3"]
    corner_uvs: Float[np.ndarray, "F 3 2"]
    texture: Float[Tensor, "R R 3"]  # the neutral's
    weights: Float[np.ndarray, "V"]
    truth: Float[np.ndarray, "V 3"]
    start: Float[np.ndarray, "V 3"]
    moves: Bool[np.ndarray, "V"]  # the skin; the rest stays where it is
    judged: Bool[np.ndarray, "V"]
    cheek: Float[np.ndarray, "V"]  # what may blush
    batch: Targets

    def tangential_mm(self, vertices: Float[np.ndarray, "V 3"]) -> Float[np.ndarray, "M"]:
        """How far along the skin each judged vertex is from its true place."""
        away, normals = vertices - self.truth, normals_of(self.truth, self.triangles)
        return MM_PER_M * np.linalg.norm(away - (away * normals).sum(1, keepdims=True) * normals, axis=1)[self.judged]

    def loss(self, size_px: int, dtype: torch.dtype = torch.float32) -> SurfaceTexture:
        return SurfaceTexture(self.triangles, self.corner_uvs, self.texture.to(dtype), self.weights, size_px)

    def disturbed(self, gain: float, blush: float) -> Targets:
        """The images with a gain, and with a smooth reddish brightening of the cheek."""
        renderer = Renderer(self.triangles, self.corner_uvs, self.cheek[:, None].astype(np.float32))
        drawn = renderer(torch.as_tensor(self.truth, dtype=torch.float32), None, self.batch.pixels)
        share = blush * drawn.classes * torch.tensor([1.0, 0.4, 0.4])
        return replace(self.batch, rgb=(gain * self.batch.rgb * (1 + share)).clamp(0, 1))


def normals_of(vertices: Float[np.ndarray, "V 3"], triangles: Int[np.ndarray, "F 3"]) -> Float[np.ndarray, "V 3"]:
    return vertex_normals(torch.as_tensor(vertices), torch.as_tensor(triangles.astype(np.int64))).numpy()


def noise(
    points: Float[np.ndarray, "P 3"], wavelengths_mm: tuple[float, float], seed: int, waves: int = 60
) -> Float[np.ndarray, "P"]:
    """Band-limited noise in space, of variance 1: plane waves in all directions, their frequencies in a band."""
    rng = np.random.default_rng(seed)
    direction = rng.standard_normal((waves, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    frequency = MM_PER_M / np.exp(rng.uniform(*np.log(wavelengths_mm), waves))
    phase = (points @ (direction * frequency[:, None]).T + rng.random(waves)) * 2 * np.pi
    return np.cos(phase).sum(1) * np.sqrt(2 / waves)


def camera(centre: np.ndarray, yaw: float, pitch: float, height_m: float, height_px: int) -> Camera:
    """A camera a metre away that looks at the centre, +Y up; so much height, in so many pixels, in a larger image."""
    turn, lift = np.radians([yaw, pitch])
    out = np.array([np.sin(turn) * np.cos(lift), np.sin(lift), np.cos(turn) * np.cos(lift)])
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
    """Linear; the noise is drawn in the space of the vertices at rest, with a contrast over the mean colour."""
    atlas = texels(triangles, corner_uvs, size_px)
    colour = SKIN * (1 + contrast * noise(atlas.interpolate(rest, triangles), wavelengths_mm, seed=1)[:, None])
    return torch.as_tensor(atlas.image(colour, 0.3).clip(0.02, 0.95), dtype=torch.float32)


def photograph(
    triangles: np.ndarray,
    corner_uvs: np.ndarray,
    vertices: np.ndarray,
    texture: Tensor,
    compared: Float[np.ndarray, "V"],
    cameras: Sequence[Camera],
    pixel_noise: float = 0.0,
) -> Targets:
    """All pixels of all views; those that show nothing but compared vertices have a weight."""
    renderer = Renderer(triangles, corner_uvs, compared[:, None].astype(np.float32), pixel_samples=16)
    pixels = Pixels.full(cameras)
    drawn = renderer(torch.tensor(vertices, dtype=torch.float32), texture, pixels)
    count = len(pixels.view)
    grain = pixel_noise * torch.randn(count, 3, generator=torch.Generator().manual_seed(0))
    none = torch.zeros(count)
    return Targets(
        names=tuple(f"cam{k}" for k in range(len(cameras))),
        class_names=("skin",),
        pixels=pixels,
        rgb=(drawn.rgb + grain).clamp(0, 1),
        rgb_weight=(drawn.classes[:, 0] > 0.99).float(),
        normals=torch.zeros(count, 3),
        normal_weight=none,
        mask=drawn.mask,
        mask_weight=none,
        classes=drawn.classes,
        class_weight=none,
        landmarks={},
        px_per_head=cameras[0].height_px / _FRAME,
    )


def times_seen(vertices: np.ndarray, triangles: np.ndarray, cameras: Sequence[Camera]) -> Int[np.ndarray, "V"]:
    """How many cameras see each vertex, at 60 degrees from its normal or less."""
    total, normals = np.zeros(len(vertices), np.int64), normals_of(vertices, triangles)
    for view in cameras:
        away = view.centre - vertices
        cosine = (away * normals).sum(1) / np.linalg.norm(away, axis=1)
        total += (cosine > 0.5) & visible(vertices, vertices, triangles, view)
    return total


def slid(truth: np.ndarray, triangles: np.ndarray, moves: np.ndarray, amount_mm: float) -> Float[np.ndarray, "V 3"]:
    """The skin moved along itself by this length (rms), smoothly: in small steps, each put back onto the surface."""
    field = np.stack([noise(truth, (60, 120), seed=seed, waves=20) for seed in (11, 12, 13)], 1)
    normals = normals_of(truth, triangles)
    length = np.sqrt(np.square(field - (field * normals).sum(1, keepdims=True) * normals)[moves].sum(1).mean())
    field *= amount_mm / MM_PER_M / length / _SLIDE_STEPS
    faces = triangles[moves[triangles].all(1)]
    out = truth.copy()
    for _ in range(_SLIDE_STEPS):
        normals = normals_of(out, triangles)
        step = field - (field * normals).sum(1, keepdims=True) * normals
        _, face, barycentric = closest_points((out + step)[moves], truth, faces)
        out[moves] = barycentric_points(truth, faces, face, barycentric)
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
    """An expression of a model's head.

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
    middle = (truth[face].min(0) + truth[face].max(0)) / 2
    height = 1.6 * float(np.ptp(truth[face, 1]))
    cameras = [camera(middle, *view, height, head_px) for view in views]
    rest, triangles = data.template_vertex_positions, data.triangles
    texture = noise_texture(triangles, corner_uvs, rest, texture_px, contrast=contrast, wavelengths_mm=(5.0, 20.0))
    apart = vertex_classes(data)[1][:, [1, 2, 6]].sum(1)  # eyes and mouth interior
    judged = face & outside & (lids(data) < 0.5) & (inner_lips(data) < 0.5)
    judged &= times_seen(truth, triangles, cameras) > 1
    left_cheek = truth[(blush(data) > 0.5) & (rest[:, 0] > 0)].mean(0)
    return Problem(
        triangles=triangles,
        corner_uvs=corner_uvs,
        texture=texture,
        weights=confident_texels(data, np.ones(len(truth))),
        truth=truth,
        start=slid(truth, triangles, outside, slide_mm),
        moves=outside,
        judged=face
        & outside
        & (lids(data) < 0.5)
        & (inner_lips(data) < 0.5)
        & (times_seen(truth, triangles, cameras) > 1),
        cheek=np.exp(-0.5 * np.square((truth - left_cheek) / 0.025).sum(1)),
        batch=photograph(triangles, corner_uvs, truth, texture, 1 - apart, cameras, pixel_noise),
    )


class OnSurface:
    """Mean squared distance from the true surface, in mm^2: nothing that tells where on it a vertex belongs."""

    def __init__(self, problem: Problem):
        self._truth = problem.truth
        self._faces = problem.triangles[problem.moves[problem.triangles].all(1)]
        self._moves = torch.as_tensor(np.flatnonzero(problem.moves))
        self._calls = 0

    def __call__(self, vertices: Tensor) -> Tensor:
        own = vertices.index_select(0, self._moves)
        if self._calls % _SURFACE_EVERY == 0:
            _, face, barycentric = closest_points(own.detach().numpy(), self._truth, self._faces)
            a, b, c = (self._truth[self._faces[face, k]] for k in range(3))
            normal = np.cross(b - a, c - a)
            normal /= np.linalg.norm(normal, axis=1, keepdims=True)
            foot = barycentric_points(self._truth, self._faces, face, barycentric)
            self._foot, self._normal = (torch.as_tensor(p, dtype=torch.float32) for p in (foot, normal))
        self._calls += 1
        return (MM_PER_M * ((own - self._foot) * self._normal).sum(1)).square().mean()


def fit(
    problem: Problem,
    terms: Mapping[str, Term],
    start: Float[np.ndarray, "V 3"],
    stages: Sequence[tuple[int, float, float, float]],
) -> Float[np.ndarray, "V 3"]:
    """Move the skin's vertices by large steps; stages are steps, smoothing (mm), first and last rate (m)."""
    moves = np.flatnonzero(problem.moves)
    local = np.cumsum(problem.moves) - 1
    own = local[problem.triangles[problem.moves[problem.triangles].all(1)]]
    ends = problem.truth[moves][edges(own).vertices]
    edge_length = float(np.median(np.linalg.norm(ends[:, 0] - ends[:, 1], axis=1)))
    base, index = torch.as_tensor(start, dtype=torch.float32), torch.as_tensor(moves)
    offsets = torch.zeros(len(moves), 3)
    for steps, smoothing_mm, first, last in stages:
        large = LargeSteps(
            own, len(moves), edge_length_m=edge_length, smoothing_m=smoothing_mm / MM_PER_M, device=base.device
        )
        latent = large.latent(offsets).requires_grad_()

        def objective(step: int, large: LargeSteps = large, latent: Tensor = latent) -> dict[str, Tensor]:
            vertices = base.index_add(0, index, large.displacement(latent))
            return {name: term(vertices) for name, term in terms.items()}

        _, failure = minimize([AdamUniformBlock(latent, Rate(start=first, end=last))], objective, steps)
        assert failure is None, failure
        offsets = large.displacement(latent).detach()
    return base.index_add(0, index, offsets).double().numpy()
