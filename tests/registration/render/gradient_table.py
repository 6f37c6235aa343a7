"""The renderer's gradient against central differences: moving parts of a scene x groups of channels.

Differences average many rays per pixel; the gradient averages seeds until its standard error is small. The adjoint
image of a cell is the change of its channels under the motion, so that contributions do not cancel. Run it with:

    python -m tests.registration.render.gradient_table
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
import torch

from registration.model import gnm_npz
from registration.model.atlas import texture_atlas
from registration.model.regions import crossing_parts, vertex_classes
from registration.render.renderer import Renderer
from registration.types import Camera, Pixels, Rendered
from tests.conftest import FIXTURES, SHARED

SIZE_PX = 160
PIXEL_SAMPLES = 64  # of the differences
STANDARD_ERROR = 0.005
SWEEP_PX = 2.0  # half step of the difference that becomes the adjoint: more than a pixel, so that edges stay inside
NEAR_PX = 0.4  # half step of the difference that is compared
SEEDS = (4, 40)  # minimum and maximum
CHANNELS: dict[str, Callable[[Rendered], torch.Tensor]] = {
    "rgb": lambda image: image.rgb,
    "normal": lambda image: image.normals,
    "class": lambda image: image.classes,
    "mask": lambda image: image.mask,
}
TINY = FIXTURES / "tiny_gnm.npz"
REAL = SHARED / "data" / "gnm" / "gnm_head_reconstructed.npz"


@dataclass(frozen=True, kw_only=True)
class Scene:
    name: str
    vertices: np.ndarray  # (V, 3), metres
    triangles: np.ndarray  # (F, 3)
    corner_uvs: np.ndarray  # (F, 3, 2)
    classes: np.ndarray  # (V, K)
    parts: np.ndarray  # (F,)
    cameras: Sequence[Camera]

    def renderer(self, pixel_samples: int, edge_samples: float = 1.0) -> Renderer:
        return Renderer(
            self.triangles,
            self.corner_uvs,
            self.classes,
            parts=self.parts,
            pixel_samples=pixel_samples,
            edge_samples=edge_samples,
        )

    @cached_property
    def pixels(self) -> Pixels:
        """All pixels that a small motion can change."""
        everywhere = Pixels.full(self.cameras)
        mask = self.renderer(4)(torch.tensor(self.vertices), None, everywhere).mask
        near = torch.nn.functional.max_pool2d(everywhere.image(mask[:, None]).permute(0, 3, 1, 2), 9, 1, 4)[:, 0]
        return Pixels.from_mask(self.cameras, near > 0)

    @property
    def centre(self) -> np.ndarray:
        return (self.vertices.min(0) + self.vertices.max(0)) / 2

    @property
    def pixel_m(self) -> float:
        """Metres that a pixel spans at the scene's centre."""
        camera = self.cameras[0]
        return float(np.linalg.norm(camera.centre - self.centre) / camera.intrinsics[0, 0])


@dataclass(frozen=True, kw_only=True)
class Cell:
    motion: str
    channel: str
    difference: float  # central difference
    gradient: float  # mean over seeds
    standard_error: float  # relative
    seeds: int

    @property
    def error(self) -> float:
        return (self.gradient - self.difference) / abs(self.difference)

    def __str__(self) -> str:
        return (
            f"{self.motion:12s} {self.channel:7s} difference {self.difference:11.5g}  gradient {self.gradient:11.5g}  "
            f"standard error {100 * self.standard_error:4.2f}% ({self.seeds:2d} seeds)  error {100 * self.error:+6.2f}%"
        )


def head(file: Path, name: str) -> Scene:
    """A model at rest between two cameras, one before and one behind it: all sides and the open neck are visible."""
    data = gnm_npz.read(file)
    vertices = data.template_vertex_positions
    centre, span = (vertices.min(0) + vertices.max(0)) / 2, float(np.ptp(vertices, 0).max())
    return Scene(
        name=name,
        vertices=vertices,
        triangles=data.triangles,
        corner_uvs=texture_atlas(data),
        classes=vertex_classes(data)[1],
        parts=crossing_parts(data),
        cameras=[
            look_at(centre, azimuth, elevation, 0.9, 1.2 * span) for azimuth, elevation in ((-0.8, 0.1), (2.3, 0))
        ],
    )


def table(scene: Scene) -> list[Cell]:
    """All cells of a scene."""
    return [*motion_cells(scene), texel_cell(scene)]


def look_at(target: np.ndarray, azimuth: float, elevation: float, distance_m: float, fill_m: float) -> Camera:
    """A camera around a target (m); `fill_m` is the height that the image spans at the target's distance."""
    out = np.array([np.sin(azimuth) * np.cos(elevation), np.sin(elevation), np.cos(azimuth) * np.cos(elevation)])
    z = -out
    x = np.cross(z, [0.0, 1.0, 0.0])
    x /= np.linalg.norm(x)
    rotation = np.stack([x, np.cross(z, x), z])
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, -rotation @ (target + distance_m * out)
    focal = SIZE_PX * distance_m / fill_m
    # An off-centre principal point: a mistake in its sign must show.
    intrinsics = np.array([[focal, 0, SIZE_PX * 0.513], [0, focal * 1.01, SIZE_PX * 0.488], [0, 0, 1.0]])
    return Camera(width_px=SIZE_PX, height_px=SIZE_PX, intrinsics=intrinsics, T_cam_world=pose)


def soft_texture(size: int = 256, seed: int = 0) -> torch.Tensor:
    """Smooth coloured noise, many texels to a period, so that differences stay linear; it jumps at the seams."""
    from scipy.ndimage import gaussian_filter

    rng = np.random.default_rng(seed)
    noise = np.stack([gaussian_filter(rng.standard_normal((size, size)), size / 40, mode="wrap") for _ in range(3)], -1)
    return torch.tensor(0.5 + 0.15 * noise / noise.std(), dtype=torch.float32)


def motions(scene: Scene) -> dict[str, np.ndarray]:
    """Unit-speed motions of the vertices (V, 3), in metres per metre of the fastest vertex."""
    p = scene.vertices.astype(np.float64) - scene.centre
    nose = p[:, 2].argmax()
    falloff = np.exp(-((p - p[nose]) ** 2).sum(1) / (2 * (0.25 * np.ptp(p[:, 0])) ** 2))
    fields = {
        "translation": np.tile([1.0, 0.3, 0.2], (len(p), 1)),
        "rotation": np.cross([0.2, 1.0, 0.1], p),
        "scale": p,
        "bump": falloff[:, None] * np.array([0.6, 0.2, 0.77]),
    }
    return {name: field / np.linalg.norm(field, axis=1).max() for name, field in fields.items()}


def motion_cells(scene: Scene) -> list[Cell]:
    """One cell for every motion and channel."""
    texture = soft_texture()
    fine = scene.renderer(PIXEL_SAMPLES)
    base = torch.tensor(scene.vertices)
    attached = base.clone().requires_grad_()
    # Every adjoint of one renderer draws new silhouette samples: its seeds. The interior is smooth and needs few rays.
    still = scene.renderer(16, edge_samples=8.0)(attached, texture, scene.pixels)

    def change(step_px: float, field: torch.Tensor) -> Rendered:
        step = step_px * scene.pixel_m * field
        with torch.no_grad():
            ahead, behind = (fine(base + s * step, texture, scene.pixels) for s in (1, -1))
        return Rendered(**{k: getattr(ahead, k) - getattr(behind, k) for k in vars(ahead)})

    cells = []
    for motion, field in motions(scene).items():
        direction = torch.tensor(field, dtype=torch.float32)
        wide, near = change(SWEEP_PX, direction), change(NEAR_PX, direction)
        for channel, pick in CHANNELS.items():
            adjoint = pick(wide)
            values: list[float] = []
            while len(values) < SEEDS[0] or (_standard_error(values) > STANDARD_ERROR and len(values) < SEEDS[1]):
                (grad,) = torch.autograd.grad(pick(still), attached, adjoint, retain_graph=True)
                values.append((grad.double() * direction.double()).sum().item())
            difference = (adjoint.double() * pick(near).double()).sum().item() / (2 * NEAR_PX * scene.pixel_m)
            cells.append(
                Cell(
                    motion=motion,
                    channel=channel,
                    difference=difference,
                    gradient=float(np.mean(values)),
                    standard_error=_standard_error(values),
                    seeds=len(values),
                )
            )
    return cells


def _standard_error(values: list[float]) -> float:
    """Relative standard error of the mean."""
    return float(np.std(values, ddof=1) / np.sqrt(len(values)) / abs(np.mean(values)))


def texel_cell(scene: Scene) -> Cell:
    """The texels' cell: RGB is linear in the texture, so one wide difference is exact."""
    texture, change = soft_texture(), soft_texture(seed=1) - 0.5
    base = torch.tensor(scene.vertices)
    renderer = scene.renderer(PIXEL_SAMPLES)
    with torch.no_grad():
        images = [renderer(base, texture + s * change, scene.pixels).rgb for s in (0.5, -0.5)]
    adjoint = images[0] - images[1]
    attached = texture.clone().requires_grad_()
    (grad,) = torch.autograd.grad(renderer(base, attached, scene.pixels).rgb, attached, adjoint)
    return Cell(
        motion="texels",
        channel="rgb",
        difference=adjoint.double().square().sum().item(),
        gradient=(grad.double() * change.double()).sum().item(),
        standard_error=0.0,
        seeds=1,
    )


def main() -> None:
    from registration.render import backend

    backend.activate()
    for file, name in ((TINY, "synthetic head"), (REAL, "head")):
        print(name, *(table(head(file, name)) if file.is_file() else ["left out: no such file"]), sep="\n", end="\n\n")


if __name__ == "__main__":
    main()
