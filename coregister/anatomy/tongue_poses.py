"""Poses of the tongue that fit an open mouth, drawn with a rig [GNM, Tongue Modeling and Articulation]."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from coregister.anatomy.tongue_mouth import JawOpening, Mouth
from coregister.anatomy.tongue_rig import CONTROLS, TongueRig
from registration.errors import InputError
from registration.model.gnm_npz import GNMData

# Mean and standard deviation of the controls of a tongue in an open mouth, body and tip; units of the rig. It is lifted
# off the lower teeth and a little out, as for a movement that a camera sees.
_DRAWN: dict[str, tuple[tuple[float, float], tuple[float, float]]] = {
    "curl": ((4.0, 8.0), (5.0, 16.0)),
    "bend": ((0.0, 8.0), (0.0, 14.0)),
    "twist": ((0.0, 5.0), (0.0, 12.0)),
    "roll": ((5.0, 14.0), (5.0, 20.0)),
    "groove": ((0.3, 1.0), (0.3, 1.0)),
    "protrusion": ((4.0, 4.0), (2.0, 3.0)),
    "shift": ((0.0, 1.0), (0.0, 1.5)),
    "raise": ((5.5, 1.4), (1.0, 1.4)),
    "width": ((-0.04, 0.06), (-0.04, 0.10)),
}
_LIMIT = 2.5  # standard deviations
_TRIES = 60  # for one pose, on average, before a mouth counts as too tight
_HINGE = -0.08, 0.12  # range of the border between body and tip


@dataclass(frozen=True, kw_only=True)
class PoseSettings:
    """What is drawn, and what is kept.

    Attributes:
        mouths: expressions in which poses are drawn, where no registrations are given.
        gap_mm: range of their gap between the incisors, beyond the template's.
        expression_spread: standard deviation of the expressions' other coefficients.
        pose_spread: factor on the standard deviations of the poses.
        penetration_mm: the deepest that a pose may lie in teeth, palate, lips or cheeks, beyond the tongue as the jaw
            carries it.
        volume_change: the largest change of the tongue's volume, as a fraction.
    """

    mouths: int = 50
    gap_mm: tuple[float, float] = (20.0, 40.0)
    expression_spread: float = 0.5
    pose_spread: float = 0.9
    penetration_mm: float = 0.2
    volume_change: float = 0.1


@dataclass(frozen=True, kw_only=True, eq=False)
class DrawnPoses:
    """N accepted poses, and how many were rejected for what."""

    displacements: Float[np.ndarray, "N T 3"]  # of the tongue's vertices, metres
    rejected: dict[str, int]
    tight: int  # mouths in which fewer poses fitted than were wanted


def model_expressions(
    data: GNMData, settings: PoseSettings, rng: np.random.Generator
) -> Iterator[Float[np.ndarray, "V 3"]]:
    """Give the displacements of expressions of the model with an open mouth, metres."""
    jaw = JawOpening.of(data)
    for _ in range(settings.mouths):
        gap = rng.uniform(*settings.gap_mm) * 1e-3
        yield jaw.displacement(jaw.coefficients(gap, rng, settings.expression_spread))


def draw_poses(
    rig: TongueRig,
    data: GNMData,
    expressions: Sequence[Float[np.ndarray, "V 3"]],
    count: int,
    settings: PoseSettings,
    rng: np.random.Generator,
) -> DrawnPoses:
    """Draw poses until as many fit, equally many in each expression where they do.

    Args:
        rig: of the model's tongue.
        data: the model.
        expressions: displacements of all vertices from the template, the tongue carried by the jaw; metres.
        count: N.
        settings: of the draws.
        rng: of the draws.

    Raises:
        InputError: too few poses fit.
    """
    template = data.template_vertex_positions.astype(np.float64)
    rejected = {"volume": 0, "teeth and gums": 0, "skin": 0}
    kept: list[Float[np.ndarray, "N 3"]] = []
    tight = 0
    for number, expression in enumerate(expressions):
        mouth = Mouth(data, template + expression)
        # What earlier mouths were too tight for is drawn in later ones.
        wanted, tries = -(-(count - len(kept)) // (len(expressions) - number)), 0
        before = len(kept)
        while len(kept) < before + wanted and tries < _TRIES * (1 + len(kept) - before):
            posed = rig.pose(draw_controls(rng, settings.pose_spread), hinge=rng.uniform(*_HINGE))
            tries += 1
            if (reason := _reason_against(rig, mouth, posed, settings)) is not None:
                rejected[reason] += 1
            else:
                kept.append(posed - rig.structure.rest)
        tight += len(kept) < before + wanted
    if len(kept) < count:
        raise InputError(
            "Too few poses of the tongue fit the open mouths",
            where="expressions, registrations",
            expected=f"{count} poses in {len(expressions)} mouths",
            got=f"{len(kept)}; {tight} mouths were too tight; rejected for {rejected}",
            fix="give registrations with the mouth open, or none: then the model's own expressions are used",
        )
    return DrawnPoses(displacements=np.stack(kept), rejected=rejected, tight=tight)


def draw_controls(rng: np.random.Generator, spread: float = 1.0) -> Float[np.ndarray, "C"]:
    """Draw the controls of one pose of a tongue in an open mouth, in the order of `CONTROLS`."""
    means, deviations = np.array([part for kind in _DRAWN.values() for part in kind]).T
    assert len(means) == len(CONTROLS)
    return means + spread * deviations * np.clip(rng.normal(size=len(means)), -_LIMIT, _LIMIT)


def _reason_against(
    rig: TongueRig, mouth: Mouth, posed: Float[np.ndarray, "N 3"], settings: PoseSettings
) -> str | None:
    """Why a pose does not fit; None: it does."""
    if abs(rig.volume_ratio(posed) - 1) > settings.volume_change:
        return "volume"
    in_mouth = mouth.carried + posed - rig.structure.rest
    for skin in (False, True):  # the teeth are the faster question
        for name, depth in mouth.excess_mm(in_mouth, skin=skin).items():
            if depth > settings.penetration_mm:
                return name
    return None
