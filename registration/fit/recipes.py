"""Stages and recipes: which variables are free, what is compared, at which resolution, for how long.

A recipe is the result of a function without parameters; its values are saved with every registration.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

from registration.errors import InputError
from registration.import_paths import load_named


@dataclass(frozen=True, kw_only=True)
class Rate:
    """A learning rate: `start`, held for a fraction of the steps, then decaying geometrically to `end`."""

    start: float
    end: float
    hold: float = 0.0  # fraction of the steps

    def value(self, progress: float) -> float:
        """Return the rate when a fraction `progress` of the steps is done."""
        fall = max(0.0, progress - self.hold) / max(1e-9, 1.0 - self.hold)
        return self.start * (self.end / self.start) ** fall


@dataclass(frozen=True, kw_only=True)
class Weights:
    """Factor of each loss; 0 leaves it out. Image losses are means over the subject's pixels."""

    normals: float = 1.0
    normal_truncation: float = 2.0  # length of the difference of unit normals beyond which it is an outlier
    lid_normal_truncation: float = 2.0  # the same on the eyelids, which may fold over one another
    rgb: float = 0.0
    ssim: float = 0.0
    mask: float = 0.5
    classes: float = 0.2
    eye_classes: float = 4.0  # times `classes`, of the eyes: small, but the eyelids depend on them
    landmarks: float = 0.02
    landmark_sigma_px: float = 3.0  # at 512 px of head height; of landmarks whose spread is not known
    landmark_likelihood: float = 0.02  # of landmarks whose spread is known, in place of `landmarks`
    landmarks_along_skin: bool = False  # whether the latter move free skin along itself only
    identity: float = 3.7e-5  # sum of squared coefficients
    expression: float = 3.1e-5
    rotations: float = 0.1  # joints other than the root, per rad^2
    parts: float = 3.3e-5  # the same of those that move no skin, where they alone are free
    eyes: float = 1.0  # translation of the eyeballs relative to the model, per m^2
    eye_scale: float = 2e-3
    offsets: float = 2e4  # per m^2: the assumed strength of the image losses, against which `Lengths` are balanced
    contacts: float = 0.0  # per mm^2 of excess depth, summed by area over the vertices inside another part
    folds: float = 0.0  # of the area of faces that turn against their neighbours, as a share of the skin's
    tongue: float = 1e-5  # the same of the tongue, which is mostly occluded: about as strong as its prior
    slide: float = 0.0  # dissimilarity of the neutral's texture and the unwrapped images; expressions only
    depth: float = 1e5  # per m^2 of robust squared distance from the depth maps, where there are any
    depth_scale_mm: float = 5.0  # distance at which the pull of depths fades: wrong ones, hair, holes that were filled
    scan: float = 0.0  # per m^2 of robust squared distance from the scan, where it is fitted
    scan_scale_mm: float = 1.0  # distance at which the scan's pull fades: hair, holes filled by a program, noise


@dataclass(frozen=True, kw_only=True)
class Lengths:
    """How smooth free offsets are, in mm (see losses/regularization.py and geometry/large_steps.py)."""

    smoothing_mm: float  # size of the patch that a step moves: affects the path of the optimization, not its minimum
    half_gain_mm: float  # wavelength of a deformation that regularization halves; shorter ones are reduced more
    decay_mm: float = 25.0  # over which an offset decays where there is no data


@dataclass(frozen=True, kw_only=True)
class OffsetRegion:
    """A part of the skin where offsets have lengths and a step size of their own."""

    name: str  # a key of regions.offset_regions
    length: float = 1.0  # factor of a stage's smoothing and half-gain lengths
    rate_scale: float = 1.0  # factor of a stage's rate, relative to the largest gradients in the region itself


@dataclass(frozen=True, kw_only=True)
class Stage:
    """Steps with one set of free variables and weights."""

    name: str
    steps: int
    level: int  # of the pyramid: 0 is the finest, each next one half
    views_per_step: int = 8
    weights: Weights = Weights()
    free: tuple[tuple[str, Rate], ...] = ()  # variables and their rates; all but `offsets` are updated by Adam
    lengths: Lengths | None = None  # needed while `offsets` is free
    texture: bool = False  # estimate texture and camera gains
    landmark_slide: bool = False  # before it, carry the skin along itself to where landmarks are

    def frees(self, name: str) -> bool:
        """Return whether a variable is free in this stage."""
        return any(name == variable for variable, _ in self.free)


@dataclass(frozen=True, kw_only=True)
class Recipe:
    """The schedule of a fit."""

    name: str
    stages: tuple[Stage, ...]
    finest_head_px: int = 512  # resolution of level 0, as the head's height
    levels: int = 3
    coarsest_head_px: int = 128  # resolution below which no level is reduced, however small the images are
    texture_px: int = 1024  # at most; less for small images (`FitContext.texture_px`)
    slide_px: int = 512  # of the textures that the `slide` loss compares
    edge_samples: float = (
        1.0  # per pixel of silhouette, for its gradient; 0: none, as in renderers without edge sampling
    )
    scale: bool = True  # free the overall size, which a basis built from scale-free data does not contain
    regions: tuple[OffsetRegion, ...] = (
        OffsetRegion(name="lips", length=0.6),
        OffsetRegion(name="lids", length=0.4),
        OffsetRegion(name="nostrils", length=0.5, rate_scale=10.0),
    )

    def __post_init__(self) -> None:
        """Refuse numbers that no fit can use, before anything is computed.

        Raises:
            InputError: a count or size is below its least, or a stage's level is none of the recipe's.
        """
        least = {"finest_head_px": 1, "levels": 1, "coarsest_head_px": 0, "texture_px": 1, "slide_px": 1}
        for name, minimum in least.items():
            self._require(name, getattr(self, name), f"{minimum} or more", getattr(self, name) >= minimum)
        for stage in self.stages:
            for name in ("steps", "views_per_step"):
                self._require(
                    f"{name} of stage {stage.name}", getattr(stage, name), "1 or more", getattr(stage, name) >= 1
                )
            known = 0 <= stage.level < self.levels
            self._require(f"level of stage {stage.name}", stage.level, f"0 to {self.levels - 1}", known)

    def _require(self, name: str, got: float, expected: str, met: bool) -> None:
        if not met:
            raise InputError(
                "A number of the recipe is out of range",
                where=f"recipe {self.name}, {name}",
                expected=expected,
                got=got,
                fix="correct the function that returns the recipe",
            )


_POSE = (("root", 5e-3), ("joints", 5e-3), ("position", 1e-3), ("eyes", 1e-3))


_SCAN = 3e4  # per m^2
_LID_NORMAL_TRUNCATION = 0.45  # 26 degrees: a rim, where the image shows the lid that covers it
_SLIDE_MM = 5.0  # smoothing of the stage before which the skin is carried along itself: the surface is known roughly
_COARSE_MM = 10.0  # smoothing beyond which the head's shape is still unknown, and closest points are wrong ones


def _rates(*pairs: tuple[str, float], end: float = 0.05) -> tuple[tuple[str, Rate], ...]:
    return tuple((name, Rate(start=rate, end=rate * end, hold=0.5)) for name, rate in pairs)


_PARTS = _rates(("parts", 0.05), end=0.2)


def _model(steps: int) -> Stage:
    return Stage(
        name="model",
        steps=steps,
        level=2,
        free=_rates(("identity", 0.1), ("expression", 0.03), ("scale", 3e-3), *_POSE),
    )


def _offsets(
    smoothing_mm: float, half_gain_mm: float, steps: int, level: int, start: float, end: float, views: int = 8
) -> Stage:
    # Pose and expression are fixed: offsets would compensate their drift, which teeth, without offsets, would follow.
    return Stage(
        name=f"offsets {smoothing_mm:g} mm",
        steps=steps,
        level=level,
        views_per_step=views,
        lengths=Lengths(smoothing_mm=smoothing_mm, half_gain_mm=half_gain_mm),
        free=(("offsets", Rate(start=start, end=end)), ("eyes", Rate(start=start / 10, end=end / 10))),
        weights=Weights(
            lid_normal_truncation=_LID_NORMAL_TRUNCATION,
            rgb=0.6,
            classes=0.1,
            landmarks=0.01,
            landmark_likelihood=0.001,
            landmarks_along_skin=True,
            contacts=2e-4,
            folds=5.0,
            slide=0.5,
            depth_scale_mm=max(0.5, 0.3 * smoothing_mm),
            scan=_SCAN if smoothing_mm < _COARSE_MM else 0.0,
            scan_scale_mm=max(0.5, 0.3 * smoothing_mm),
        ),
        texture=True,
        landmark_slide=smoothing_mm == _SLIDE_MM,
    )


def draft(*, scale: bool = True) -> Recipe:
    """Minutes: the model's parameters, then offsets, up to a head of about 512 px."""
    stages = (
        _model(100),
        _offsets(20, 12, 30, level=2, start=4e-3, end=2e-3),
        _offsets(5, 8, 40, level=1, start=1e-3, end=5e-4),
        _offsets(2.5, 6, 30, level=1, start=4e-4, end=5e-5),
        _offsets(1.5, 5, 40, level=0, start=2e-4, end=2e-5, views=4),
    )
    return Recipe(name="draft", stages=stages, scale=scale)


def studio(*, scale: bool = True) -> Recipe:
    """Full quality: twice draft's steps, eight views in each, up to a head of about 1024 px."""
    stages = (
        _model(150),
        _offsets(20, 12, 50, level=2, start=4e-3, end=2e-3),
        _offsets(5, 8, 80, level=1, start=1e-3, end=5e-4),
        _offsets(2.5, 6, 60, level=1, start=4e-4, end=5e-5),
        _offsets(1.5, 4, 90, level=0, start=3e-4, end=1e-5),
    )
    return Recipe(name="studio", stages=stages, scale=scale, finest_head_px=1024)


def preview(*, scale: bool = True) -> Recipe:
    """For a first look: half of draft's steps and views, two levels up to a head of 256 px, no contact penalty."""
    stages = (
        _model(70),
        _offsets(20, 12, 20, level=1, start=4e-3, end=2e-3),
        _offsets(5, 8, 25, level=0, start=1e-3, end=5e-4),
        _offsets(1.5, 5, 25, level=0, start=2e-4, end=2e-5),
    )
    plain = (
        replace(
            stage,
            level=min(stage.level, 1),
            views_per_step=4,
            weights=replace(stage.weights, contacts=0.0, tongue=0.0),
        )
        for stage in stages
    )
    return Recipe(name="preview", stages=tuple(plain), scale=scale, finest_head_px=256, levels=2, texture_px=512)


def in_model(*, scale: bool = True) -> Recipe:
    """No offsets: the model's parameters alone, to test how much of a head a model can represent."""
    fine = replace(_model(60), name="model, finer", level=1)
    slow = tuple((name, replace(rate, start=rate.start / 3, end=rate.end / 3)) for name, rate in fine.free)
    return Recipe(name="in_model", stages=(_model(100), replace(fine, free=slow, texture=True)), scale=scale)


def rigid_stage(level: int) -> Stage:
    """Return a stage for pose and size alone, to compare initial guesses."""
    rates = (("root", 2e-2), ("position", 3e-3), ("scale", 1e-2))
    free = tuple((name, Rate(start=rate, end=rate * 0.2)) for name, rate in rates)
    weights = Weights(mask=1.0, landmarks=0.0, landmark_likelihood=0.0, tongue=0.0)
    return Stage(name="rigid", steps=30, level=level, free=free, weights=weights)


def expression_recipe(recipe: Recipe) -> Recipe:
    """Return the recipe for an expression that starts from its subject's neutral: identity and size are fixed.

    Identity components that move no skin, of teeth and eyes, are free: the neutral may not have shown them.
    """
    fixed = ("identity", "scale")
    stages = tuple(
        replace(
            stage,
            free=(*((name, rate) for name, rate in stage.free if name not in fixed), *_PARTS),
            landmark_slide=False,  # the neutral's texture tells where skin is along itself
        )
        for stage in recipe.stages
    )
    return replace(recipe, stages=stages)


RECIPES: dict[str, Callable[[], Recipe]] = {
    "preview": preview,
    "draft": draft,
    "studio": studio,
    "in_model": in_model,
}


def named_recipe(name: str) -> str:
    """Return the name of a recipe of `RECIPES`. Jobs may name no other: an import path runs code of the sender's.

    Raises:
        InputError: no such name.
    """
    if name not in RECIPES:
        raise InputError(
            "There is no such recipe", where="recipe", expected=" or ".join(RECIPES), got=name, fix="choose one of them"
        )
    return name


def load_recipe(recipe: str | Recipe) -> Recipe:
    """Return the recipe of a name or import path (`registration.import_paths.load_named`).

    Args:
        recipe: a key of `RECIPES`, an import path, or a Recipe.

    Raises:
        InputError: as `load_named`.
    """
    return load_named(recipe, RECIPES, Recipe, title="recipe")
