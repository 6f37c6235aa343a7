"""Stages and recipes: which unknowns are free, what is compared, at which resolution, for how long.

A recipe is a function that returns its stages; the resolved values are saved with every result.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

from registration.optimize import Rate


@dataclass(frozen=True, kw_only=True)
class Weights:
    """How much each term counts; 0 leaves it out. Image terms are means over the subject's pixels."""

    normals: float = 1.0
    normal_truncation: float = 2.0  # length of a normal's error beyond which it is an outlier
    rgb: float = 0.0
    ssim: float = 0.0
    mask: float = 0.5
    classes: float = 0.2
    eye_classes: float = 4.0  # times `classes`, for eyes: small, but lids depend on them
    landmarks: float = 0.02
    landmark_sigma_px: float = 3.0  # at 512 px of head height
    identity: float = 2e-3
    expression: float = 2e-3
    rotations: float = 0.1  # joints other than the root, per rad^2
    eyes: float = 5.0  # eyeballs moved out of the model's place, per m^2
    eye_scale: float = 0.05
    offset_l2: float = 20.0  # per m^2
    offset_laplacian: float = 2e4  # per m^2
    offset_coupling: float = 200.0  # per m^2


@dataclass(frozen=True, kw_only=True)
class Stage:
    """A run of steps with one set of free unknowns."""

    name: str
    steps: int
    level: int  # of the pyramid: 0 is the finest, each next one half
    views_per_step: int = 8
    weights: Weights = Weights()
    free: tuple[tuple[str, Rate], ...] = ()  # unknowns and their rates; all but `offsets` are updated by Adam
    smoothing_mm: float = 0.0  # length that large steps smooth offsets over; used while `offsets` is free
    texture: bool = False  # estimate texture and camera gains along the way

    def frees(self, name: str) -> bool:
        return any(name == unknown for unknown, _ in self.free)


@dataclass(frozen=True, kw_only=True)
class Recipe:
    name: str
    stages: tuple[Stage, ...]
    finest_head_px: int = 512  # resolution of level 0, as the head's height
    levels: int = 3
    texture_px: int = 1024
    scale: bool = True  # free the overall size: a basis rebuilt from scale-free data holds none


_POSE = (("root", 5e-3), ("joints", 5e-3), ("position", 1e-3), ("eyes", 1e-3))


def _rates(*pairs: tuple[str, float], end: float = 0.05) -> tuple[tuple[str, Rate], ...]:
    return tuple((name, Rate(start=rate, end=rate * end, hold=0.5)) for name, rate in pairs)


def _offsets(
    name: str, steps: int, level: int, smoothing_mm: float, start: float, end: float, ssim: float = 0.2
) -> Stage:
    return Stage(
        name=name,
        steps=steps,
        level=level,
        smoothing_mm=smoothing_mm,
        free=(("offsets", Rate(start=start, end=end)), ("eyes", Rate(start=start / 10, end=end / 10))),
        weights=Weights(rgb=1.0, ssim=ssim, classes=0.1, landmarks=0.01),
        texture=True,
    )


def draft(*, scale: bool = True) -> Recipe:
    """Minutes on a laptop: model, then offsets up to a head of about 512 px."""
    model = Stage(
        name="model",
        steps=100,
        level=2,
        free=_rates(("identity", 0.1), ("expression", 0.03), ("scale", 3e-3), *_POSE),
    )
    stages = (
        model,
        _offsets("offsets 20 mm", 30, 2, 20, 4e-3, 2e-3),
        _offsets("offsets 8 mm", 40, 1, 8, 1e-3, 5e-4),
        _offsets("offsets 4 mm", 30, 1, 4, 4e-4, 5e-5),
        _offsets("offsets 3 mm", 40, 0, 3, 2e-4, 2e-5, ssim=0.0),
    )
    return Recipe(name="draft", stages=stages, scale=scale)


def studio(*, scale: bool = True) -> Recipe:
    """The full quality: all views at every step, longer, up to the images' own resolution."""
    base = draft(scale=scale)
    longer = {"model": 150, "offsets 20 mm": 50, "offsets 8 mm": 80, "offsets 4 mm": 60, "offsets 3 mm": 90}
    stages = tuple(replace(stage, steps=longer[stage.name], views_per_step=12) for stage in base.stages)
    return replace(base, name="studio", stages=stages, finest_head_px=1024, texture_px=2048)


def rigid(level: int) -> Stage:
    """Pose and size alone, to judge a start."""
    rates = (("root", 2e-2), ("position", 3e-3), ("scale", 1e-2))
    free = tuple((name, Rate(start=rate, end=rate * 0.2)) for name, rate in rates)
    return Stage(name="rigid", steps=30, level=level, free=free, weights=Weights(mask=1.0, landmarks=0.0))


def expression_of(recipe: Recipe) -> Recipe:
    """The same recipe for an expression that starts from its subject's neutral: identity and size stay."""
    kept = ("identity", "scale")
    stages = tuple(
        replace(stage, free=tuple((name, rate) for name, rate in stage.free if name not in kept))
        for stage in recipe.stages
    )
    return replace(recipe, stages=stages)


RECIPES: dict[str, Callable[[], Recipe]] = {"draft": draft, "studio": studio}
