"""Small synthetic captures of forty people, one in five spoiled in a known way before it is registered."""

import shutil
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from bench.support import spoiled_captures as spoil
from coregister.synthetic.capture import LABELS, Studio
from coregister.synthetic.subject import synthesize_capture
from registration.capture.colmap import read_cameras
from registration.degrading.degradation import DegradationPreset
from registration.degrading.degrade import degrade
from registration.fit.recipes import Recipe, preview
from registration.render.studio.shoot import Quality

NEUTRAL = "neutral"
EXPRESSIONS = (
    *("smile", "jaw_open", "pucker", "brows_up", "anger", "sadness", "funnel", "squint", "cheeks_blown"),
    *("brows_down", "compress", "viseme_ee"),
)
PER_SUBJECT = 4  # expressions; the last one is spoiled
SIZE_PX, VIEWS = 144, 6
NOISE = DegradationPreset(  # of all captures, in pixels of these small images
    name="gate",
    camera_rms_px=0.05,
    normal_rms_deg=5.0,
    normal_outliers=0.02,
    landmark_std_px=0.2,
    landmark_outliers=0.03,
    landmark_outlier_px=(5.0, 20.0),
    boundary_px=0.3,
    gain_spread=0.1,
    channel_spread=0.02,
    noise_at_white=0.02,
)


@dataclass(frozen=True, kw_only=True)
class Sample:
    """One registration of the benchmark."""

    subject: int  # seed of the person
    expression: str
    way: str = ""  # how it is spoiled; empty: it is not

    @property
    def name(self) -> str:
        return f"synth_{self.subject:04d}/{self.expression}"

    @property
    def seed(self) -> int:
        """Of its errors."""
        return 10_000 + 100 * self.subject + sorted((NEUTRAL, *EXPRESSIONS)).index(self.expression)


def samples(subjects: int, first_seed: int = 0) -> list[Sample]:
    """Return all registrations: each person's neutral, three good expressions and one that is spoiled."""
    found, ways = [], list(WAYS)
    for number in range(subjects):
        chosen = expressions_of(first_seed + number)
        found.append(Sample(subject=first_seed + number, expression=NEUTRAL))
        found += [Sample(subject=first_seed + number, expression=name) for name in chosen[:-1]]
        found.append(Sample(subject=first_seed + number, expression=chosen[-1], way=ways[number % len(ways)]))
    return found


def expressions_of(seed: int) -> list[str]:
    """Return a person's expressions."""
    return np.random.default_rng([seed, 5]).permutation(EXPRESSIONS)[:PER_SUBJECT].tolist()


def make_capture(sample: Sample, out: Path) -> Path:
    """Write the capture of a sample, with noise and, if it is to be, spoiled. Returns its folder; an existing is kept.

    Args:
        sample: which.
        out: folder of the subjects' captures.
    """
    target = out / sample.name
    if target.exists():
        return target
    clean = _clean(sample.subject, sample.expression, out)
    temporary = target.with_name(f".{sample.expression}")
    shutil.rmtree(temporary, ignore_errors=True)
    degrade(clean, temporary, preset=NOISE, seed=sample.seed)
    if sample.way:
        other = _clean(sample.subject + 1, expressions_of(sample.subject + 1)[0], out)
        WAYS[sample.way](Spoiled(root=temporary, other=other, rng=np.random.default_rng(sample.seed)))
    for name in ("scan.ply", "ground_truth.npz"):
        (temporary / name).unlink(missing_ok=True)
    temporary.rename(target)
    return target


def recipe(sample: Sample) -> Recipe:
    """Return the recipe of a sample: a short `preview`; of one that is stopped far too early, a twentieth of it."""
    base = preview()
    steps = {"model": 40, "offsets 20 mm": 8, "offsets 5 mm": 14}
    stages = tuple(
        replace(stage, steps=max(2, steps[stage.name] // (20 if sample.way == EARLY else 1)), views_per_step=3)
        for stage in base.stages
        if stage.name in steps
    )
    name = "gate, too short" if sample.way == EARLY else "gate"
    return replace(base, name=name, stages=stages, texture_px=256, slide_px=256)


@dataclass(frozen=True, kw_only=True)
class Spoiled:
    """What a way of spoiling works on."""

    root: Path  # the capture
    other: Path  # a clean capture of another person
    rng: np.random.Generator

    @property
    def views(self) -> list[str]:
        return sorted(Path(name).stem for name in read_cameras(self.root / "sparse"))


def _clean(seed: int, expression: str, out: Path) -> Path:
    root = out / ".clean" / f"{seed:04d}_{expression}"
    if not root.exists():
        quality = Quality(pixel_samples=2, light_rays=8, subdivisions=0)
        size = (SIZE_PX, SIZE_PX)
        studio = Studio(
            cameras=VIEWS, size_px=size, seed=seed, quality=quality, texture_size=512, hair=True, shirt=True
        )
        synthesize_capture(root, seed=seed, expression=expression, studio=studio)
    return root


def _other_person(it: Spoiled) -> None:
    """A capture of another person, filed under this one."""
    settings = (it.root / "capture.toml").read_text()
    shutil.rmtree(it.root)
    degrade(it.other, it.root, preset=NOISE, seed=int(it.rng.integers(2**31)))
    (it.root / "capture.toml").write_text(settings)


def _cameras_exchanged(it: Spoiled) -> None:
    """The calibrations of two neighbouring cameras are exchanged."""
    first = int(it.rng.integers(len(it.views) - 1))
    names = it.views[first : first + 2]
    found = {Path(name).stem: camera for name, camera in read_cameras(it.root / "sparse").items()}
    exchanged = dict(zip(names, reversed(names), strict=True))
    spoil.cameras(it.root, lambda stem, _: found[exchanged.get(stem, stem)])


def _labels_mirrored(it: Spoiled) -> None:
    """The label maps of all views are mirrored, as by a network that was trained with the wrong augmentation."""
    spoil.images("segmentation", lambda image: image[:, ::-1])(it.root)


def _nothing(it: Spoiled) -> None:
    """The capture is good; its recipe is too short."""


def _landmark_outliers(it: Spoiled) -> None:
    """Of the landmarks in every view, 40 % are far off, with full confidence."""

    def change(points: np.ndarray) -> np.ndarray:
        result = points.copy()
        off = it.rng.random(len(points)) < 0.4
        angle, distance = it.rng.uniform(0, 2 * np.pi, off.sum()), it.rng.uniform(8, 30, off.sum())
        result[off, :2] += (distance * [np.cos(angle), np.sin(angle)]).T
        return result

    spoil.landmarks(change)(it.root)


def _view_of_another(it: Spoiled) -> None:
    """One view shows another person: image, mask, normals, labels and landmarks."""
    name = it.views[int(it.rng.integers(len(it.views)))]
    for folder, suffix in (
        *((folder, ".png") for folder in ("images", "masks", "normals", "segmentation")),
        ("landmarks", ".json"),
    ):
        shutil.copyfile(it.other / folder / f"{name}{suffix}", it.root / folder / f"{name}{suffix}")


def _wrong_scale(it: Spoiled) -> None:
    """The world of this capture is 12 % larger than that of the neutral: another calibration target."""
    spoil.world(1.12)(it.root)


def _hair_is_skin(it: Spoiled) -> None:
    """Hair and clothes are labelled as skin."""
    table = np.arange(256, dtype=np.uint8)
    table[[LABELS.index("hair"), LABELS.index("clothes")]] = LABELS.index("skin")
    spoil.images("segmentation", lambda image: table[image])(it.root)


EARLY = "stopped far too early"
WAYS: Mapping[str, Callable[[Spoiled], None]] = {
    "another person": _other_person,
    "cameras exchanged": _cameras_exchanged,
    "labels mirrored": _labels_mirrored,
    EARLY: _nothing,
    "landmark outliers": _landmark_outliers,
    "a view of another person": _view_of_another,
    "wrong scale": _wrong_scale,
    "hair and clothes as skin": _hair_is_skin,
}
