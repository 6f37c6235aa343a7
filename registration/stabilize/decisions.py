"""Actions on components, by default or by an operator's decisions, and the corrections of samples that follow from them
[GNM, Head Expression]; docs/algorithms.md, "Stabilization"."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
from jaxtyping import Float
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from registration.errors import InputError
from registration.frames import MM_PER_M, transform_points
from registration.geometry.rigid import motion_fields
from registration.stabilize.components import HeadGeometry, RegionalComponents, label_effects

Action = Literal["keep", "subtract", "drop"]
ACTIONS: tuple[Action, ...] = get_args(Action)
_FADE_M = 10e-3  # distance from a region's border over which a dropped component fades in


@dataclass(frozen=True, kw_only=True)
class Decision:
    """An operator's decision about one component."""

    region: str
    component: int  # from 0
    action: Action
    reason: str = ""


@dataclass(frozen=True, kw_only=True)
class Corrections:
    """Motions of the whole head and dropped components, which are removed from S samples; the head frame."""

    twists: Float[np.ndarray, "S 6"]  # radians and metres, about the head's centre
    # Coefficients, and the displacement per unit coefficient in metres, of each dropped component.
    dropped: tuple[tuple[Float[np.ndarray, "S"], Float[np.ndarray, "V 3"]], ...]

    def T_corrected_head(self, sample: int) -> Float[np.ndarray, "4 4"]:
        """Return the transform that undoes a sample's head motion.

        Args:
            sample: its index.

        Returns:
            p_corrected = T_corrected_head @ p_head; both in the head frame.
        """
        rotation, translation = self.twists[sample, :3], self.twists[sample, 3:]
        transform = np.eye(4)
        transform[:3, :3] = Rotation.from_rotvec(-rotation).as_matrix()
        transform[:3, 3] = -transform[:3, :3] @ translation
        return transform

    def apply(self, points: Float[np.ndarray, "V 3"], sample: int) -> Float[np.ndarray, "V 3"]:
        """Remove head motion and dropped components from a sample.

        Args:
            points: its vertices after the automatic stage, in the head frame, metres.
            sample: its index.

        Returns:
            The corrected vertices.
        """
        corrected = transform_points(self.T_corrected_head(sample), points)
        for coefficients, displacement in self.dropped:
            corrected = corrected - coefficients[sample] * displacement
        return corrected


@dataclass(frozen=True, kw_only=True)
class CorrectionEffect:
    """Size of the corrections over the exterior skin."""

    rms_mm: float
    max_mm: float  # rms of the sample with the largest correction
    rotation_deg: float  # rms of the removed rotations
    samples_mm: Float[np.ndarray, "S"]  # rms of each sample


def default_actions(components: Sequence[RegionalComponents]) -> dict[tuple[str, int], Action]:
    """Return the action without decisions by (region, component): subtract what is flagged, keep the rest."""
    return {
        (part.region, k): "subtract" if part.flagged[k] else "keep"
        for part in components
        for k in range(len(part.energy))
    }


def decided_actions(
    components: Sequence[RegionalComponents], decisions: Sequence[Decision]
) -> dict[tuple[str, int], Action]:
    """Replace default actions by an operator's decisions.

    Args:
        components: of all regions.
        decisions: in order; the last one about a component counts.

    Returns:
        The action for each (region, component).

    Raises:
        InputError: a decision names a component or an action that does not exist.
    """
    actions = default_actions(components)
    for decision in decisions:
        key = (decision.region, decision.component)
        if key not in actions or decision.action not in ACTIONS:
            sizes = ", ".join(f"{part.region} 0 to {len(part.energy) - 1}" for part in components)
            raise InputError(
                "A decision names a component or an action that does not exist",
                where=f"{decision.region}, component {decision.component}",
                expected=f"one of {sizes}; {', '.join(ACTIONS)}",
                got=decision.action,
                fix="correct the decision",
            )
        actions[key] = decision.action
    return actions


def compute_corrections(
    components: Sequence[RegionalComponents],
    actions: Mapping[tuple[str, int], Action],
    labels: Sequence[str],
    head: HeadGeometry,
) -> Corrections:
    """Compute the corrections of all samples.

    *Subtract*: one rigid motion of the whole head is fitted to the rigid parts of all subtracted components, over the
    skin of their regions, and undone; the shape of the face stays. Subtraction region by region is worse: with
    injected motions of known size (`python -m bench.stabilization`) it removes 74 to 96 % of them instead of 85 to
    99 %, since the jaw hides the motion of the mouth region, and up to a quarter of a small expression (brows) instead
    of 7 %. The part of the coefficients that labels explain (`label_effects`) is not subtracted: it is expression,
    which chance correlation mixes into a component.

    *Drop*: the component is removed in its region, and fades in over 10 mm from the border.

    Args:
        components: of all regions.
        actions: for each (region, component).
        labels: of all samples.
        head: regions of the model.

    Returns:
        The head motion of each sample, zero if nothing is subtracted, and the dropped components.
    """
    gram, right_side = np.zeros((6, 6)), np.zeros((len(labels), 6))
    dropped = []
    for part in components:
        subtracted = np.array([actions[part.region, k] == "subtract" for k in range(len(part.energy))], bool)
        if subtracted.any():
            fields = motion_fields(head.points[part.rows])
            region_gram = np.einsum("irc,r,jrc->ij", fields, head.area[part.rows], fields)
            coefficients = part.coefficients[:, subtracted]
            gram += region_gram
            right_side += (coefficients - label_effects(coefficients, labels)) @ part.twists[subtracted] @ region_gram
        for k in range(len(part.energy)):
            if actions[part.region, k] == "drop":
                dropped.append((part.coefficients[:, k], dropped_displacement(part, k, head)))
    twists = np.linalg.lstsq(gram, right_side.T, rcond=None)[0].T if gram.any() else right_side
    return Corrections(twists=twists, dropped=tuple(dropped))


def dropped_displacement(part: RegionalComponents, component: int, head: HeadGeometry) -> Float[np.ndarray, "V 3"]:
    """Return what dropping a component removes from every vertex, metres per unit coefficient."""
    field = np.zeros_like(head.points)
    field[part.rows] = part.modes[component] * _border_fade(part, head)[:, None]
    return field


def correction_effect(corrections: Corrections, head: HeadGeometry) -> CorrectionEffect:
    """Measure how far corrections displace the exterior skin, to first order in the rotations.

    Args:
        corrections: of all samples.
        head: vertices and areas of the model.

    Returns:
        Area-weighted rms displacements in mm, and the rms rotation in degrees.
    """
    fields = [*motion_fields(head.points), *(field for _, field in corrections.dropped)]
    weights = np.column_stack([corrections.twists, *(coefficients for coefficients, _ in corrections.dropped)])
    stacked = np.stack(fields)
    gram = np.einsum("ivc,v,jvc->ij", stacked, head.area, stacked, optimize=True) / head.area.sum()
    mean_squares = np.maximum(np.einsum("si,ij,sj->s", weights, gram, weights), 0)
    rotations_deg = np.degrees(np.linalg.norm(corrections.twists[:, :3], axis=1))
    return CorrectionEffect(
        rms_mm=float(MM_PER_M * np.sqrt(mean_squares.mean())),
        max_mm=float(MM_PER_M * np.sqrt(mean_squares.max())),
        rotation_deg=float(np.sqrt((rotations_deg**2).mean())),
        samples_mm=MM_PER_M * np.sqrt(mean_squares),
    )


def _border_fade(part: RegionalComponents, head: HeadGeometry) -> Float[np.ndarray, "R"]:
    """Return a smooth step: 0 at the region's border, 1 from 10 mm inside."""
    outside = np.setdiff1d(np.flatnonzero(head.area > 0), part.rows)
    if not len(outside):
        return np.ones(len(part.rows))
    depth = np.clip(cKDTree(head.points[outside]).query(head.points[part.rows])[0] / _FADE_M, 0, 1)
    return depth**2 * (3 - 2 * depth)
