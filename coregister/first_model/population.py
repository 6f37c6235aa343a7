"""Randomly sampled people: weights of MakeHuman's targets and demographic tags.

The first model's identity basis is built from symmetric people of 25 years and average build (`sample_spanned_person`).
Test subjects may be asymmetric, of any adult age and build: targets outside the basis (`sample_unspanned_person`).
"""

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from itertools import product

import numpy as np

from coregister.first_model.makehuman import MakeHuman

_ETHNICITIES = ("african", "asian", "caucasian")
_GENDERS = ("female", "male")
_FOLDERS = ("head", "nose", "mouth", "eyes", "ears", "chin", "cheek", "forehead", "eyebrows", "neck")
# MakeHuman's name suffixes of a slider's two ends.
_ENDS = (
    ("decr", "incr"),
    ("down", "up"),
    ("backward", "forward"),
    ("in", "out"),
    ("compress", "uncompress"),
    ("concave", "convex"),
)
# Sliders that translate whole parts, that make fantasy ears, or that move the head against the body, which rigid
# alignment would undo.
_EXCLUDED = re.compile(
    r"ears/.-ear-(shape-(pointed|square|triangle))|head/head-(trans|square|rectangular|diamond|triangular|angle)"
    r"|head/head-invertedtriangular|mouth/mouth-trans-(in|out)|nose/nose-trans-(in|out)|neck/neck-trans-(in|out)"
)
_SLIDER_STD = 0.2  # at weight 1 a slider's ends are caricatures
_ASYMMETRY_STD = 0.18


@dataclass(frozen=True, kw_only=True)
class SyntheticPerson:
    """One head as weights of MakeHuman's targets, with demographic tags."""

    weights: Mapping[str, float]  # by target name
    tags: Mapping[str, str | int] = field(default_factory=dict)  # gender, age in years, ethnicity


@dataclass(frozen=True, kw_only=True)
class Slider:
    """A symmetric shape detail: the targets of its two ends, on one or both sides of the face."""

    low: tuple[str, ...]  # empty for a slider with one end
    high: tuple[str, ...]


def mean_person() -> SyntheticPerson:
    """Return the person of the first model's template: mean gender and ethnicity, 25 years, all sliders at zero."""
    return SyntheticPerson(weights=_macros(np.full(3, 1 / 3), 0.5, 0.5, 0.5, 0.5))


def sample_spanned_person(source: MakeHuman, rng: np.random.Generator) -> SyntheticPerson:
    """Sample a person of the first model's identity basis: symmetric, 25 years, average build.

    Args:
        source: MakeHuman's head.
        rng: source of randomness.
    """
    mix, male = rng.dirichlet(np.full(3, 0.6)), float(rng.beta(0.5, 0.5))
    weights = _macros(mix, male, 0.5, 0.5, 0.5)
    for slider in sliders(source):
        weights |= _slider_weights(slider, float(np.clip(rng.normal(0, _SLIDER_STD), -1, 1)))
    return _person(weights, mix, male, 0.5)


def sample_unspanned_person(source: MakeHuman, rng: np.random.Generator) -> SyntheticPerson:
    """Sample a subject of any adult age and build, with asymmetries; the first model's basis does not span it.

    Args:
        source: MakeHuman's head.
        rng: source of randomness.
    """
    mix, male = rng.dirichlet(np.full(3, 0.3)), float(rng.integers(0, 2))
    age = float(rng.uniform(0.45, 0.95))
    muscle, weight = (float(np.clip(rng.normal(0.5, 0.2), 0, 1)) for _ in range(2))
    weights = _macros(mix, male, age, muscle, weight)
    for slider in sliders(source):
        weights |= _slider_weights(slider, float(np.clip(rng.normal(0, _SLIDER_STD), -1, 1)))
    for pair in _asymmetries(source):
        side = int(rng.integers(0, 2))
        weights[pair[side]] = float(np.clip(abs(rng.normal(0, _ASYMMETRY_STD)), 0, 1))
    return _person(weights, mix, male, age)


def sliders(source: MakeHuman) -> list[Slider]:
    """Return all symmetric shape details in a fixed order."""
    names = [n for n in sorted(source.targets) if n.split("/")[0] in _FOLDERS and not _EXCLUDED.match(n)]
    names = [n for n in names if "/r-" not in n]  # the left side's names stand for both sides
    result, used = [], set[str]()
    for name in names:
        if name in used:
            continue
        opposite = _opposite_end(name, set(names))
        if opposite is None:
            result.append(Slider(low=(), high=_both_sides(name)))
        elif opposite[1]:  # `name` is the lower end
            result.append(Slider(low=_both_sides(name), high=_both_sides(opposite[0])))
        else:
            result.append(Slider(low=_both_sides(opposite[0]), high=_both_sides(name)))
        used |= {name} | ({opposite[0]} if opposite else set())
    return result


def _opposite_end(name: str, names: set[str]) -> tuple[str, bool] | None:
    """Return the target of the slider's opposite end, and whether `name` is the lower end; None without one."""
    for low, high in _ENDS:
        for end, opposite, lower in ((low, high, True), (high, low, False)):
            if name.endswith(f"-{end}") and (twin := f"{name.removesuffix(end)}{opposite}") in names:
                return twin, lower
    return None


def _both_sides(name: str) -> tuple[str, ...]:
    return (name, name.replace("/l-", "/r-")) if "/l-" in name else (name,)


def _slider_weights(slider: Slider, value: float) -> dict[str, float]:
    names = slider.high if value >= 0 else slider.low
    return {name: abs(value) for name in names}


def _asymmetries(source: MakeHuman) -> list[tuple[str, str]]:
    lefts = sorted(n for n in source.targets if n.startswith("asym/asym-") and n.endswith("-l"))
    return [(name, f"{name[:-1]}r") for name in lefts]


def _macros(mix: np.ndarray, male: float, age: float, muscle: float, weight: float) -> dict[str, float]:
    """Return MakeHuman's macro weights: products of ethnicity, gender, age, muscle and weight."""
    ages = _blend(("child", "young", "old"), (0.1875, 0.5, 1.0), age)
    genders = dict(zip(_GENDERS, (1 - male, male), strict=True))
    builds = [
        _blend(tuple(f"{end}{kind}" for end in ("min", "average", "max")), (0.0, 0.5, 1.0), value)
        for kind, value in (("muscle", muscle), ("weight", weight))
    ]
    weights = {
        f"macrodetails/{ethnicity}-{gender}-{year}": mixture * genders[gender] * part
        for (ethnicity, mixture), gender, (year, part) in product(
            zip(_ETHNICITIES, mix.tolist(), strict=True), _GENDERS, ages.items()
        )
    }
    weights |= {
        f"macrodetails/universal-{gender}-{year}-{a}-{b}": genders[gender] * part * builds[0][a] * builds[1][b]
        for gender, (year, part), a, b in product(_GENDERS, ages.items(), builds[0], builds[1])
    }
    return {name: value for name, value in weights.items() if value > 0}


def _blend(names: tuple[str, ...], knots: tuple[float, ...], value: float) -> dict[str, float]:
    """Return linear interpolation weights of the names whose knots enclose a value."""
    result = dict.fromkeys(names, 0.0)
    last = int(np.clip(np.searchsorted(knots, value), 1, len(knots) - 1))
    t = float(np.clip((value - knots[last - 1]) / (knots[last] - knots[last - 1]), 0, 1))
    result[names[last - 1]], result[names[last]] = 1 - t, t
    return result


def _person(weights: Mapping[str, float], mix: np.ndarray, male: float, age: float) -> SyntheticPerson:
    years = np.interp(age, (0.1875, 0.5, 1.0), (12, 25, 90))
    return SyntheticPerson(
        weights=weights,
        tags={
            "gender": _GENDERS[int(male >= 0.5)],
            "age": int(round(float(years))),
            "ethnicity": _ETHNICITIES[int(mix.argmax())],
        },
    )
