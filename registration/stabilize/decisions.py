"""What is done about components, and the set that is rebuilt from it (docs/algorithms.md, "Stabilization")."""

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
from registration.stabilize.components import Components, Head, label_part

Action = Literal["keep", "subtract", "drop"]
ACTIONS: tuple[Action, ...] = get_args(Action)
_TAPER = 10e-3  # metres from a region's border over which a dropped component fades in


@dataclass(frozen=True, kw_only=True)
class Decision:
    """What a person decided about one component, and why."""

    region: str
    component: int  # from 0
    action: Action
    reason: str = ""


@dataclass(frozen=True, kw_only=True)
class Corrections:
    """What is taken from every sample: a motion of the whole head, and dropped components."""

    twists: Float[np.ndarray, "S 6"]  # radians and metres, about the head's centre, in its frame
    dropped: tuple[tuple[Float[np.ndarray, "S"], Float[np.ndarray, "V 3"]], ...]  # coefficients, displacement of one

    def T_head_head(self, sample: int) -> Float[np.ndarray, "4 4"]:
        """Undoes the head's motion: to where the skull is from where it was taken to be."""
        turn, shift = self.twists[sample, :3], self.twists[sample, 3:]
        back = np.eye(4)
        back[:3, :3] = Rotation.from_rotvec(-turn).as_matrix()
        back[:3, 3] = -back[:3, :3] @ shift
        return back

    def corrected(self, points: Float[np.ndarray, "V 3"], sample: int) -> Float[np.ndarray, "V 3"]:
        """A stabilized head, in the head's frame, with both taken from it."""
        moved = transform_points(self.T_head_head(sample), points)
        for coefficients, displacement in self.dropped:
            moved = moved - coefficients[sample] * displacement
        return moved


@dataclass(frozen=True, kw_only=True)
class Change:
    """How the rebuilt set differs from what it was built from, over the exterior skin."""

    rms_mm: float
    most_mm: float  # rms of the sample that changes most
    turn_deg: float  # rms of the head's turns that are taken out
    samples_mm: Float[np.ndarray, "S"]


def default_actions(components: Sequence[Components]) -> dict[tuple[str, int], Action]:
    """Subtract what is flagged, keep all else."""
    return {
        (part.region, k): "subtract" if part.flagged[k] else "keep"
        for part in components
        for k in range(len(part.energy))
    }


def decided_actions(components: Sequence[Components], decisions: Sequence[Decision]) -> dict[tuple[str, int], Action]:
    """The default actions with a person's decisions in their place; the last one about a component counts.

    Raises InputError for a decision about a component that there is not, or for an action that there is not.
    """
    actions = default_actions(components)
    for decision in decisions:
        key = (decision.region, decision.component)
        if key not in actions or decision.action not in ACTIONS:
            sizes = ", ".join(f"{part.region} 0 to {len(part.energy) - 1}" for part in components)
            raise InputError(
                "A decision is about nothing that there is",
                where=f"{decision.region}, component {decision.component}",
                expected=f"one of {sizes}; {', '.join(ACTIONS)}",
                got=decision.action,
                fix="correct the decision",
            )
        actions[key] = decision.action
    return actions


def corrections(
    components: Sequence[Components], actions: Mapping[tuple[str, int], Action], labels: Sequence[str], head: Head
) -> Corrections:
    """What the actions take from every sample.

    *Subtract*: the rigid parts of these components, all regions', are one motion of one head: the rigid motion that
    fits them best over their regions' skin is undone for the whole head, and the face keeps its shape. To subtract
    c r region by region instead is worse. Against known truth (injected motions, `python -m bench.stabilization`)
    that removes less of the spurious motion, 74 to 96 % against 85 to 99 %, since the jaw hides the mouth's share; and
    it takes up to a quarter of a small expression (brows) along, against 7 %. Of the coefficients, what the labels
    explain is not subtracted (`label_part`): that is expression, which chance correlation mixes into a component.

    *Drop*: the component as a whole, in its region, fading in over 10 mm from the border.
    """
    gram, right = np.zeros((6, 6)), np.zeros((len(labels), 6))
    dropped = []
    for part in components:
        taken = np.array([actions[part.region, k] == "subtract" for k in range(len(part.energy))], bool)
        if taken.any():
            fields = motion_fields(head.points[part.rows])
            own = np.einsum("irc,r,jrc->ij", fields, head.area[part.rows], fields)
            chosen = part.coefficients[:, taken]
            gram += own
            right += (chosen - label_part(chosen, labels)) @ part.twists[taken] @ own
        for k in range(len(part.energy)):
            if actions[part.region, k] == "drop":
                field = np.zeros_like(head.points)
                field[part.rows] = part.modes[k] * _taper(part, head)[:, None]
                dropped.append((part.coefficients[:, k], field))
    twists = np.linalg.lstsq(gram, right.T, rcond=None)[0].T if gram.any() else right
    return Corrections(twists=twists, dropped=tuple(dropped))


def change(correction: Corrections, head: Head) -> Change:
    """How far the corrections move the skin; to first order in the turns."""
    fields = [*motion_fields(head.points), *(field for _, field in correction.dropped)]
    weights = np.column_stack([correction.twists, *(coefficients for coefficients, _ in correction.dropped)])
    flat = np.stack(fields)
    gram = np.einsum("ivc,v,jvc->ij", flat, head.area, flat, optimize=True) / head.area.sum()
    squared = np.maximum(np.einsum("si,ij,sj->s", weights, gram, weights), 0)
    turns = np.degrees(np.linalg.norm(correction.twists[:, :3], axis=1))
    return Change(
        rms_mm=float(MM_PER_M * np.sqrt(squared.mean())),
        most_mm=float(MM_PER_M * np.sqrt(squared.max())),
        turn_deg=float(np.sqrt((turns**2).mean())),
        samples_mm=MM_PER_M * np.sqrt(squared),
    )


def _taper(part: Components, head: Head) -> Float[np.ndarray, "R"]:
    """0 at the region's border, 1 from 10 mm inside."""
    outside = np.setdiff1d(np.flatnonzero(head.area > 0), part.rows)
    if not len(outside):
        return np.ones(len(part.rows))
    depth = np.clip(cKDTree(head.points[outside]).query(head.points[part.rows])[0] / _TAPER, 0, 1)
    return depth**2 * (3 - 2 * depth)
