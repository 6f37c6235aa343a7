"""Factors, their categories, and the condition vectors that a sampler's networks receive."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from registration.errors import InputError

MAX_CATEGORIES = 1024  # of a factor
_TOLERANCE = 1e-6  # by which weights may miss the sum 1 without a remark


@dataclass(frozen=True, kw_only=True)
class Factor:
    """One named property with its categories, such as gender: female, male."""

    name: str
    categories: tuple[str, ...]


@dataclass(frozen=True, kw_only=True)
class Blend:
    """Weights of a factor's categories, which sum to 1."""

    weights: Mapping[str, float]
    remark: str = ""  # what was changed to make them so


def condition_size(factors: Sequence[Factor]) -> int:
    """Return the length of a condition vector: the factors' categories, one after the other."""
    return sum(len(factor.categories) for factor in factors)


def one_hot(categories: Int[np.ndarray, "N F"], factors: Sequence[Factor]) -> Float[np.ndarray, "N C"]:
    """Return condition vectors: the one-hot vectors of all factors, concatenated.

    Args:
        categories: index of each sample's category, by factor.
        factors: F of them, in the order of the vector.
    """
    parts = [np.eye(len(factor.categories), dtype=np.float32)[categories[:, k]] for k, factor in enumerate(factors)]
    return np.concatenate(parts, 1)


def parse_blend(text: str, factor: Factor) -> Blend:
    """Read the weights of a factor's categories: `happy`, or `happy=0.7,surprise=0.3`.

    Args:
        text: names, each with a weight; a single name may have none.
        factor: whose categories they are.

    Returns:
        The weights, scaled to the sum 1; the remark says so if they had another.

    Raises:
        InputError: a category that the factor lacks, which the message lists; a category twice; a weight that is
            missing, no number, negative, not finite, or all of them 0.
    """
    weights: dict[str, float] = {}
    parts = [part.strip() for part in text.split(",") if part.strip()]
    for part in parts:
        name, equals, number = (piece.strip() for piece in part.partition("="))
        if name not in factor.categories:
            raise _invalid(factor, "There is no such category", ", ".join(factor.categories), name or "nothing")
        if name in weights:
            raise _invalid(factor, "A category is given twice", "each category once", name)
        if not equals and len(parts) > 1:
            raise _invalid(factor, "A weight is missing", f"{name}=WEIGHT", part)
        weights[name] = _weight(number, factor, part) if equals else 1.0
    total = sum(weights.values())
    if not total > 0:
        raise _invalid(factor, "The weights are all 0", "at least one positive weight", text or "nothing")
    remark = ""
    if abs(total - 1) > _TOLERANCE:
        remark = f"the weights of {factor.name} sum to {total:.6g}: they are divided by it"
    return Blend(weights={name: weight / total for name, weight in weights.items()}, remark=remark)


def blended(blends: Mapping[str, Blend], factors: Sequence[Factor]) -> Float[np.ndarray, "C"]:
    """Return the condition vector of a blend for every factor, by name."""
    return np.concatenate(
        [
            np.array([blends[factor.name].weights.get(name, 0.0) for name in factor.categories], np.float32)
            for factor in factors
        ]
    )


def _weight(number: str, factor: Factor, part: str) -> float:
    try:
        weight = float(number)
    except ValueError:
        weight = math.nan
    if not (math.isfinite(weight) and weight >= 0):
        raise _invalid(factor, "A weight is no number", "a finite number from 0", part)
    return weight


def _invalid(factor: Factor, what: str, expected: str, got: str) -> InputError:
    return InputError(what, where=f"--{factor.name}", expected=expected, got=got, fix="give categories of this sampler")
