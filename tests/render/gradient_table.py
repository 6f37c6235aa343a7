"""The renderer's gradient against central differences: moving parts of a scene x groups of channels.

Differences average many rays per pixel; the gradient averages seeds until its standard error is small. The adjoint
image of a cell is what a motion does to its channels, so that contributions do not cancel. Run it by hand:

    python -m tests.render.gradient_table
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch

from registration.render.renderer import Renderer
from registration.types import Camera, Pixels, Rendered

PIXEL_SAMPLES = 64
STANDARD_ERROR = 0.005
NEAR_PX = 0.15  # half step of the difference that is compared
MAX_SEEDS = 40
CHANNELS: dict[str, Callable[[Rendered], torch.Tensor]] = {
    "rgb": lambda image: image.rgb,
    "normal": lambda image: image.normals,
    "class": lambda image: image.classes,
    "mask": lambda image: image.mask,
}


@dataclass(frozen=True, kw_only=True)
class Scene:
    name: str
    vertices: np.ndarray  # (V, 3), metres
    triangles: np.ndarray  # (F, 3)
    corner_uvs: np.ndarray  # (F, 3, 2)
    classes: np.ndarray  # (V, K)
    cameras: Sequence[Camera]

    @property
    def pixels(self) -> Pixels:
        return Pixels.all_of(self.cameras)


@dataclass(frozen=True, kw_only=True)
class Cell:
    motion: str
    channel: str
    difference: float  # central difference
    gradient: float  # mean over seeds
    standard_error: float  # relative

    @property
    def error(self) -> float:
        return (self.gradient - self.difference) / abs(self.difference)

    def __str__(self) -> str:
        return (
            f"{self.motion:12s} {self.channel:7s} difference {self.difference:12.5g}  gradient {self.gradient:12.5g}"
            f"  standard error {100 * self.standard_error:5.2f}%  error {100 * self.error:+6.2f}%"
        )


def look_at(
    target: np.ndarray, azimuth: float, elevation: float, distance_m: float, size_px: int, fill: float
) -> Camera:
    """A camera around a target (m); `fill` is the height (m) that the image spans at the target's distance."""
    out = np.array([np.sin(azimuth) * np.cos(elevation), np.sin(elevation), np.cos(azimuth) * np.cos(elevation)])
    z = -out
    x = np.cross(z, [0.0, 1.0, 0.0])
    x /= np.linalg.norm(x)
    rotation = np.stack([x, np.cross(z, x), z])
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, -rotation @ (target + distance_m * out)
    focal = size_px * distance_m / fill
    # An off-centre principal point: a mistake in its sign must show.
    intrinsics = np.array([[focal, 0, size_px * 0.513], [0, focal * 1.01, size_px * 0.488], [0, 0, 1.0]])
    return Camera(width_px=size_px, height_px=size_px, intrinsics=intrinsics, T_cam_world=pose)


def soft_texture(size: int, seed: int = 0) -> torch.Tensor:
    """Smooth coloured noise over waves: detail at many texels per period, so that differences stay linear."""
    from scipy.ndimage import gaussian_filter

    rng = np.random.default_rng(seed)
    noise = np.stack([gaussian_filter(rng.standard_normal((size, size)), size / 40, mode="wrap") for _ in range(3)], -1)
    return torch.tensor(0.5 + 0.15 * noise / noise.std(), dtype=torch.float32)


def motions(scene: Scene) -> dict[str, np.ndarray]:
    """Unit-speed motions of the vertices (V, 3), in metres per metre of the fastest vertex."""
    v = scene.vertices.astype(np.float64)
    centre = (v.min(0) + v.max(0)) / 2
    p = v - centre
    # The bump sits where the face meets the first camera, off its axis, pushed along its silhouette and depth.
    top = p[:, 2].argmax()
    falloff = np.exp(-((p - p[top]) ** 2).sum(1) / (2 * (0.25 * np.ptp(p[:, 0])) ** 2))
    fields = {
        "translation": np.tile([1.0, 0.3, 0.2], (len(v), 1)),
        "rotation": np.cross([0.2, 1.0, 0.1], p),
        "scale": p,
        "bump": falloff[:, None] * np.array([0.6, 0.2, 0.77]),
    }
    return {name: field / np.linalg.norm(field, axis=1).max() for name, field in fields.items()}


def motion_cells(scene: Scene, texture_size: int = 256) -> list[Cell]:
    texture = soft_texture(texture_size)
    renderer = _renderer(scene)
    base = torch.tensor(scene.vertices, dtype=torch.float32)
    attached = base.clone().requires_grad_()
    still = renderer(attached, texture, scene.pixels)
    pixel_m = _pixel_size(scene)
    cells = []
    for motion, field in motions(scene).items():
        direction = torch.tensor(field, dtype=torch.float32)

        def change(step_px: float, direction=direction) -> Rendered:
            step = step_px * pixel_m * direction
            with torch.no_grad():
                ahead, behind = (renderer(base + s * step, texture, scene.pixels) for s in (1, -1))
            return Rendered(**{k: getattr(ahead, k) - getattr(behind, k) for k in vars(ahead)})

        wide, near = change(1.0), change(NEAR_PX)
        for channel, pick in CHANNELS.items():
            adjoint = pick(wide)
            difference = (adjoint.double() * pick(near).double()).sum().item() / (2 * NEAR_PX * pixel_m)
            values: list[float] = []
            while len(values) < 4 or _standard_error(values) > STANDARD_ERROR and len(values) < MAX_SEEDS:
                (grad,) = torch.autograd.grad(pick(still), attached, adjoint, retain_graph=True)
                values.append((grad.double() * direction.double()).sum().item())
            cells.append(
                Cell(
                    motion=motion,
                    channel=channel,
                    difference=difference,
                    gradient=float(np.mean(values)),
                    standard_error=_standard_error(values),
                )
            )
    return cells


def _standard_error(values: list[float]) -> float:
    """Relative standard error of the mean."""
    return float(np.std(values, ddof=1) / np.sqrt(len(values)) / abs(np.mean(values)))


def texel_cell(scene: Scene, texture_size: int = 256) -> Cell:
    """The texels' cell: RGB is linear in the texture, so one wide difference is exact."""
    texture, change = soft_texture(texture_size), soft_texture(texture_size, seed=1) - 0.5
    base = torch.tensor(scene.vertices, dtype=torch.float32)
    renderer = _renderer(scene)
    with torch.no_grad():
        images = [renderer(base, texture + s * change, scene.pixels).rgb for s in (0.5, -0.5)]
    adjoint = images[0] - images[1]
    attached = texture.clone().requires_grad_()
    (renderer(base, attached, scene.pixels).rgb * adjoint).sum().backward()
    gradient = (attached.grad.double() * change.double()).sum().item()
    return Cell(
        motion="texels",
        channel="rgb",
        difference=adjoint.double().square().sum().item(),
        gradient=gradient,
        standard_error=0.0,
    )


def _renderer(scene: Scene) -> Renderer:
    # Every adjoint of one renderer draws new silhouette samples: its seeds.
    return Renderer(scene.triangles, scene.corner_uvs, scene.classes, pixel_samples=PIXEL_SAMPLES, edge_samples=8.0)


def _pixel_size(scene: Scene) -> float:
    """Metres that a pixel spans at the scene's centre."""
    camera = scene.cameras[0]
    centre = (scene.vertices.min(0) + scene.vertices.max(0)) / 2
    return float(np.linalg.norm(camera.centre - centre) / camera.intrinsics[0, 0])
