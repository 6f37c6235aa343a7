"""People: weights of MakeHuman's targets, drawn at random, with the tags that describe them.

A *model* person is what the first model's identity basis is made of: symmetric, of the middle of adult life, of average
build. Any other person may be asymmetric, older and of any build: targets that the basis does not span.
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
# The two ends of one slider: MakeHuman names them so.
_ENDS = (
    ("decr", "incr"),
    ("down", "up"),
    ("backward", "forward"),
    ("in", "out"),
    ("compress", "uncompress"),
    ("concave", "convex"),
)
# Sliders that move whole parts about or make fairy-tale ears; and the head against the body, which alignment undoes.
_LEFT_OUT = re.compile(
    r"ears/.-ear-(shape-(pointed|square|triangle))|head/head-(trans|square|rectangular|diamond|triangular|angle)"
    r"|head/head-invertedtriangular|mouth/mouth-trans-(in|out)|nose/nose-trans-(in|out)|neck/neck-trans-(in|out)"
)
_SPREAD = 0.2  # standard deviation of a slider, whose ends at 1 are caricatures
_ASYMMETRY = 0.18


@dataclass(frozen=True, kw_only=True)
class Person:
    """One head: target name -> weight, and who it is."""

    weights: Mapping[str, float]
    tags: Mapping[str, str | int] = field(default_factory=dict)  # gender, age in years, ethnicity


@dataclass(frozen=True, kw_only=True)
class Slider:
    """A symmetric detail: the targets of its two ends, on one or both sides of the face."""

    low: tuple[str, ...]  # none for a slider with one end
    high: tuple[str, ...]


def mean_person() -> Person:
    """The first model's template: the mean of the genders and ethnicities at 25, all sliders in the middle."""
    return Person(weights=_macros(np.full(3, 1 / 3), 0.5, 0.5, 0.5, 0.5))


def model_person(source: MakeHuman, rng: np.random.Generator) -> Person:
    """One sample of the first model's identity basis."""
    mix, male = rng.dirichlet(np.full(3, 0.6)), float(rng.beta(0.5, 0.5))
    weights = _macros(mix, male, 0.5, 0.5, 0.5)
    for slider in sliders(source):
        weights |= _set(slider, float(np.clip(rng.normal(0, _SPREAD), -1, 1)))
    return _person(weights, mix, male, 0.5)


def any_person(source: MakeHuman, rng: np.random.Generator) -> Person:
    """A subject: of any adult age and build, and as asymmetric as people are."""
    mix, male = rng.dirichlet(np.full(3, 0.3)), float(rng.integers(0, 2))
    age = float(rng.uniform(0.45, 0.95))
    muscle, weight = (float(np.clip(rng.normal(0.5, 0.2), 0, 1)) for _ in range(2))
    weights = _macros(mix, male, age, muscle, weight)
    for slider in sliders(source):
        weights |= _set(slider, float(np.clip(rng.normal(0, _SPREAD), -1, 1)))
    for pair in _asymmetries(source):
        side = int(rng.integers(0, 2))
        weights[pair[side]] = float(np.clip(abs(rng.normal(0, _ASYMMETRY)), 0, 1))
    return _person(weights, mix, male, age)


def sliders(source: MakeHuman) -> list[Slider]:
    """All symmetric details, in a fixed order."""
    names = [n for n in sorted(source.targets) if n.split("/")[0] in _FOLDERS and not _LEFT_OUT.match(n)]
    names = [n for n in names if "/r-" not in n]  # the left side's stand for both
    found, taken = [], set[str]()
    for name in names:
        if name in taken:
            continue
        other = _other_end(name, set(names))
        if other is None:
            found.append(Slider(low=(), high=_both_sides(name)))
        elif other[1]:  # `name` is the lower end
            found.append(Slider(low=_both_sides(name), high=_both_sides(other[0])))
        else:
            found.append(Slider(low=_both_sides(other[0]), high=_both_sides(name)))
        taken |= {name} | ({other[0]} if other else set())
    return found


def _other_end(name: str, names: set[str]) -> tuple[str, bool] | None:
    """The slider's other end and whether `name` itself is the lower one."""
    for low, high in _ENDS:
        for end, opposite, lower in ((low, high, True), (high, low, False)):
            if name.endswith(f"-{end}") and (twin := f"{name.removesuffix(end)}{opposite}") in names:
                return twin, lower
    return None


def _both_sides(name: str) -> tuple[str, ...]:
    return (name, name.replace("/l-", "/r-")) if "/l-" in name else (name,)


def _set(slider: Slider, value: float) -> dict[str, float]:
    names = slider.high if value >= 0 else slider.low
    return {name: abs(value) for name in names}


def _asymmetries(source: MakeHuman) -> list[tuple[str, str]]:
    lefts = sorted(n for n in source.targets if n.startswith("asym/asym-") and n.endswith("-l"))
    return [(name, f"{name[:-1]}r") for name in lefts]


def _macros(mix: np.ndarray, male: float, age: float, muscle: float, weight: float) -> dict[str, float]:
    """MakeHuman's products of ethnicity, gender, age, muscle and weight."""
    ages = _blend(("child", "young", "old"), (0.1875, 0.5, 1.0), age)
    genders = dict(zip(_GENDERS, (1 - male, male), strict=True))
    builds = [
        _blend(tuple(f"{end}{kind}" for end in ("min", "average", "max")), (0.0, 0.5, 1.0), value)
        for kind, value in (("muscle", muscle), ("weight", weight))
    ]
    weights = {
        f"macrodetails/{ethnicity}-{gender}-{year}": share * genders[gender] * part
        for (ethnicity, share), gender, (year, part) in product(
            zip(_ETHNICITIES, mix.tolist(), strict=True), _GENDERS, ages.items()
        )
    }
    weights |= {
        f"macrodetails/universal-{gender}-{year}-{a}-{b}": genders[gender] * part * builds[0][a] * builds[1][b]
        for gender, (year, part), a, b in product(_GENDERS, ages.items(), builds[0], builds[1])
    }
    return {name: value for name, value in weights.items() if value > 0}


def _blend(names: tuple[str, ...], places: tuple[float, ...], value: float) -> dict[str, float]:
    """Linear weights of the two names between whose places a value lies."""
    result = dict.fromkeys(names, 0.0)
    last = int(np.clip(np.searchsorted(places, value), 1, len(places) - 1))
    share = float(np.clip((value - places[last - 1]) / (places[last] - places[last - 1]), 0, 1))
    result[names[last - 1]], result[names[last]] = 1 - share, share
    return result


def _person(weights: Mapping[str, float], mix: np.ndarray, male: float, age: float) -> Person:
    years = np.interp(age, (0.1875, 0.5, 1.0), (12, 25, 90))
    return Person(
        weights=weights,
        tags={
            "gender": _GENDERS[int(male >= 0.5)],
            "age": int(round(float(years))),
            "ethnicity": _ETHNICITIES[int(mix.argmax())],
        },
    )
