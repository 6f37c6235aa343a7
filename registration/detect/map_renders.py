"""Renders of a head model's people from known cameras, and what a detector finds in them.

People are drawn from the model's identity basis, their skin and light at random, their expressions from given
displacements. Heads are bald; the pictures are as large as those that a detector is reliable in.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, Int, UInt8
from scipy.optimize import linear_sum_assignment
from scipy.spatial.transform import Rotation

from registration.detect.provider import Face, LandmarkProvider
from registration.errors import InputError, check_seed
from registration.frames import linear_to_srgb
from registration.model.atlas import texture_atlas
from registration.model.gnm_npz import GNMData
from registration.model.regions import exterior, neck_other
from registration.progress import NullProgress, Progress
from registration.render import backend
from registration.render.studio.canvas import make_canvas
from registration.render.studio.eyes import corneas
from registration.render.studio.light import Sky
from registration.render.studio.scene import StudioSurface
from registration.render.studio.shoot import Quality, Sensor, render_views
from registration.render.studio.skin import SkinAppearance, paint_head
from registration.types import Camera

SIZE_PX = 480
YAWS_DEG = (-42.0, -28.0, -14.0, 0.0, 14.0, 28.0, 42.0)  # detectors are unreliable beyond
MAX_PITCH_DEG, ROLL_DEG = 22.0, 5.0
MAX_COEFFICIENT = 2.0  # of an identity
LOOKS = 8  # different skins
TEXTURE_SIZE = 1024
HEAD_PX = (250.0, 380.0)  # height of the head without its neck, of which the picture's height is `SIZE_PX`
DISTANCE_M = (0.7, 1.6)
MIN_FACES = 0.5  # of the pictures, below which a map is refused
_QUALITY = Quality(pixel_samples=2, light_rays=48, subdivisions=0)
_MIRRORED_YAW_DEG = 20.0  # pictures up to this yaw are also detected mirrored


@dataclass(frozen=True, kw_only=True)
class RenderSettings:
    """How many heads are rendered. Equal settings give equal pictures.

    Attributes:
        identities: number of people.
        expressions: of each person, the first of them neutral.
        seed: of all that is drawn at random.
    """

    identities: int = 24
    expressions: int = 3
    seed: int = 0

    def check(self) -> None:
        """Raise InputError if a number is out of range."""
        check_seed(self.seed)
        if not (4 <= self.identities <= 1000 and 1 <= self.expressions <= 100):
            raise InputError(
                "The number of rendered heads is out of range",
                where="identities, expressions",
                expected="4 to 1000 identities, 1 to 100 expressions",
                got=(self.identities, self.expressions),
                fix="change this option",
            )


@dataclass(frozen=True, kw_only=True, eq=False)
class Observations:
    """What a detector found in renders of H heads by C cameras each; L landmarks. World: the model's frame, metres."""

    vertices: Float[np.ndarray, "H V 3"]
    cameras: tuple[tuple[Camera, ...], ...]  # of each head
    pixels: Float[np.ndarray, "H C L 2"]  # px; NaN where no face was found
    person: Int[np.ndarray, "H"]
    expression: tuple[str, ...]  # of each head
    opposite: Int[np.ndarray, "L"]  # the landmark on the other side, itself on the middle; -1: unknown

    @property
    def found(self) -> float:
        """The fraction of the pictures in which a face was found."""
        return float(np.isfinite(self.pixels[:, :, 0, 0]).mean())


def observe(
    data: GNMData,
    provider: LandmarkProvider,
    expressions: Mapping[str, Float[np.ndarray, "V 3"]],
    settings: RenderSettings,
    progress: Progress | None = None,
) -> Observations:
    """Render people of a model and detect their landmarks.

    Args:
        data: the model.
        provider: the detector.
        expressions: displacements by name, metres, of expressions besides the neutral one; may be none.
        settings: numbers and seed.
        progress: receives a step per head.

    Raises:
        InputError: settings out of range, the model lacks the vertex groups that are painted, or faces are found in
            less than `MIN_FACES` of the pictures.
    """
    settings.check()
    progress = progress or NullProgress()
    backend.activate("llvm")
    surfaces = _Surfaces(data, settings.seed)
    total = settings.identities * settings.expressions
    heads, rigs, pixels, names, mirrored = [], [], [], [], []
    for number in range(total):
        person, turn = divmod(number, settings.expressions)
        rng = np.random.default_rng([settings.seed, 11, number])
        name, displacement = _expression(expressions, turn, rng)
        vertices = _identity(data, settings.seed, person) + displacement
        cameras = sample_cameras(data, vertices, rng)
        images = _render(surfaces.of(person, vertices), cameras, rng)
        heads.append(vertices.astype(np.float32))
        rigs.append(cameras)
        pixels.append([_detected(provider, image) for image in images])
        names.append(name)
        mirrored += _mirrored_pairs(provider, images, pixels[-1])
        progress.update(number + 1, total, "heads rendered and detected")
    observations = Observations(
        vertices=np.stack(heads),
        cameras=tuple(rigs),
        pixels=np.array(pixels),
        person=np.arange(total) // settings.expressions,
        expression=tuple(names),
        opposite=_opposite(mirrored, provider.count),
    )
    if observations.found < MIN_FACES:
        raise InputError(
            "The detector finds no faces on this model",
            where=provider.scheme,
            expected=f"a face in at least {MIN_FACES:.0%} of the pictures",
            got=f"{observations.found:.0%} of {total * len(YAWS_DEG)}",
            fix="give the model's eyes, lips and brows their vertex groups, or use another detector",
        )
    return observations


def sample_cameras(data: GNMData, vertices: Float[np.ndarray, "V 3"], rng: np.random.Generator) -> tuple[Camera, ...]:
    """Return a camera for each of `YAWS_DEG` that looks at a head, at random pitch, roll, distance and size."""
    head = vertices[exterior(data) & ~neck_other(data)]
    low, high = head.min(0), head.max(0)
    centre, height = (low + high) / 2, high[1] - low[1]
    cameras = []
    for yaw in YAWS_DEG:
        angles = [yaw + rng.uniform(-5, 5), rng.uniform(-1, 1) * MAX_PITCH_DEG]
        outward = Rotation.from_euler("YX", [angles[0], -angles[1]], degrees=True).as_matrix()
        axes = np.stack([outward[:, 0], -outward[:, 1], -outward[:, 2]])  # x right, y down, z towards the head
        axes = Rotation.from_euler("z", rng.normal(0, ROLL_DEG), degrees=True).as_matrix() @ axes
        distance = rng.uniform(*DISTANCE_M)
        T_cam_world = np.eye(4)
        T_cam_world[:3, :3] = axes
        T_cam_world[:3, 3] = (0, 0, distance) - axes @ centre
        focal = rng.uniform(*HEAD_PX) / height * distance
        intrinsics = np.array([[focal, 0, SIZE_PX / 2], [0, focal, SIZE_PX / 2], [0, 0, 1.0]])
        cameras.append(Camera(width_px=SIZE_PX, height_px=SIZE_PX, intrinsics=intrinsics, T_cam_world=T_cam_world))
    return tuple(cameras)


class _Surfaces:
    """The painted surfaces of a model's people."""

    def __init__(self, data: GNMData, seed: int):
        canvas = make_canvas(data, TEXTURE_SIZE)
        self._textures = [
            paint_head(data, canvas, SkinAppearance.sample(seed * LOOKS + number)) for number in range(LOOKS)
        ]
        self._shared: dict[str, Any] = {
            "triangles": data.triangles.astype(np.int64),
            "corner_uvs": texture_atlas(data),
            "classes": np.ones((len(data.template_vertex_positions), 1), np.float32),
            "transparent": corneas(data),
        }

    def of(self, person: int, vertices: Float[np.ndarray, "V 3"]) -> StudioSurface:
        return StudioSurface(vertices=vertices, texture=self._textures[person % LOOKS], **self._shared)


def _identity(data: GNMData, seed: int, person: int) -> Float[np.ndarray, "V 3"]:
    """The vertices of one person without expression."""
    count = len(data.vertex_identity_basis)
    drawn = np.random.default_rng([seed, 12, person]).standard_normal(count)
    coefficients = np.clip(drawn, -MAX_COEFFICIENT, MAX_COEFFICIENT).astype(np.float32)
    moved = np.tensordot(coefficients, data.vertex_identity_basis.astype(np.float32), 1)
    return data.template_vertex_positions.astype(np.float64) + moved


def _expression(
    expressions: Mapping[str, Float[np.ndarray, "V 3"]], turn: int, rng: np.random.Generator
) -> tuple[str, Float[np.ndarray, "V 3"] | float]:
    """Name and displacement: the first expression of a person is neutral, the others drawn."""
    if turn == 0 or not expressions:
        return "neutral", 0.0
    name = list(expressions)[rng.integers(len(expressions))]
    strength = rng.uniform(0.4, 1.0)
    return name, strength * expressions[name]


def _render(
    surface: StudioSurface, cameras: Sequence[Camera], rng: np.random.Generator
) -> list[UInt8[np.ndarray, "H W 3"]]:
    towards = rng.normal((0, 0.6, 0.8), 0.5)
    sky = Sky(
        brightness=float(rng.uniform(0.7, 1.1)),
        contrast=float(rng.uniform(0.3, 0.8)),
        towards=(float(towards[0]), float(towards[1]), float(towards[2])),
    )
    background = (float(rng.uniform(0.05, 0.6)),) * 3
    sensor = Sensor(shot_noise=0.01, read_noise=0.002, exposure_spread=0.05, colour_spread=0.03)
    views = render_views(
        [surface],
        cameras,
        sky=sky,
        sensor=sensor,
        quality=_QUALITY,
        background=background,
        seed=int(rng.integers(1 << 20)),
    )
    return [np.round(255 * linear_to_srgb(view.rgb)).astype(np.uint8) for view in views if view.rgb is not None]


def _detected(provider: LandmarkProvider, image: UInt8[np.ndarray, "H W 3"]) -> Float[np.ndarray, "L 2"]:
    face = _main_face(provider.detect(image))
    return np.full((provider.count, 2), np.nan) if face is None else face.points


def _main_face(faces: Sequence[Face]) -> Face | None:
    return max(faces, key=lambda face: face.presence) if faces else None


def _mirrored_pairs(
    provider: LandmarkProvider,
    images: Sequence[UInt8[np.ndarray, "H W 3"]],
    pixels: Sequence[Float[np.ndarray, "L 2"]],
) -> list[tuple[Float[np.ndarray, "L 2"], Float[np.ndarray, "L 2"]]]:
    """The points of frontal pictures, and those of the same pictures detected mirrored, turned back."""
    pairs = []
    for yaw, image, points in zip(YAWS_DEG, images, pixels, strict=True):
        if abs(yaw) > _MIRRORED_YAW_DEG or not np.isfinite(points).all():
            continue
        mirrored = _detected(provider, np.ascontiguousarray(image[:, ::-1]))
        if np.isfinite(mirrored).all():
            pairs.append((points, np.column_stack([image.shape[1] - mirrored[:, 0], mirrored[:, 1]])))
    return pairs


def _opposite(
    pairs: Sequence[tuple[Float[np.ndarray, "L 2"], Float[np.ndarray, "L 2"]]], count: int
) -> Int[np.ndarray, "L"]:
    """The landmark on the other side: the one that a mirrored picture has at the same place.

    A landmark without a mutual counterpart has -1: left and right are then not pooled.
    """
    own = np.arange(count)
    if not pairs:
        return np.full(count, -1)
    distance = np.mean([np.linalg.norm(a[:, None] - b[None], axis=2) for a, b in pairs], 0)
    matched = linear_sum_assignment(distance + distance.T)[1]
    mutual = matched[matched] == own
    return np.where(mutual, matched, -1)
