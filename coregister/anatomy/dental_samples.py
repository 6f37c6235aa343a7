"""Random dentitions: how every tooth of a sample differs from the template, and which samples are kept.

Teeth erupt until they meet, so what varies is not independent: neighbours touch, antagonists fit each other, and the
larger a front tooth's overjet, the deeper its overbite. `Spreads` says how much of each deviation a tooth shares.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from coregister.anatomy.dental_rig import ArchPose, RiggedArch, ToothPose

# Congenitally missing teeth by kind, of all missing ones [Polder 2004]: second premolars and upper lateral incisors.
_MISSING = {35: 0.21, 45: 0.21, 12: 0.115, 22: 0.115, 15: 0.105, 25: 0.105, 31: 0.02, 41: 0.02, 14: 0.05, 24: 0.05}
_CROWDED_TURN_DEG = 8.0  # for each millimetre of crowding
_LEFT_OUT = np.array([0.75, 0.75, 0.10])  # size of a missing tooth, which stays in the gum as a flat remnant


@dataclass(frozen=True, kw_only=True)
class Spreads:
    """Standard deviations of dentitions; teeth differ by all of these at once."""

    turn_deg: float = 4.0  # of a tooth about each of its axes
    shift_mm: float = 0.5  # of a tooth outwards and upwards; along the arch it keeps in contact
    size: float = 0.05  # of its width, depth and height, fraction
    arch: float = 0.05  # of the arches' width and of their length, fraction
    overjet_mm: float = 1.0
    overbite_mm: float = 1.0
    gap_mm: float = 0.08  # between neighbours
    wear_mm: float = 0.3  # of the biting edges
    missing: float = 0.02  # of the dentitions lack a tooth
    reach_mm: float = 12.0  # along the arch, over which turns and shifts are alike
    shared: float = 0.85  # share of the variance of turns and shifts that neighbours and antagonists have in common
    jaws: float = 0.1  # share of the arches' deviations that upper and lower do not have in common
    overlap_overjet: float = 0.8  # correlation of overbite and overjet
    crowding_mm: float = 0.4  # by which every second front tooth stands outwards, with a turn
    clearance_mm: float = 1.1  # of antagonists at rest, where the template has less


@dataclass(frozen=True, kw_only=True, eq=False)
class Dentition:
    """The rigs of both arches, with what couples their teeth."""

    upper: RiggedArch
    lower: RiggedArch
    lowered: float  # of the lower arch, metres: the teeth at rest are apart

    @property
    def arches(self) -> tuple[RiggedArch, RiggedArch]:
        return self.upper, self.lower


def draw_poses(dentition: Dentition, spreads: Spreads, count: int, rng: np.random.Generator) -> list[ArchPose]:
    """Draw how both arches of `count` dentitions differ from the template."""
    arcs = [np.array([rig.arc for rig in arch.teeth]) for arch in dentition.arches]
    place = np.concatenate([arcs[0], arcs[1] * (np.ptp(arcs[0]) / np.ptp(arcs[1]))])
    fdi = np.array([tooth.fdi for arch in dentition.arches for tooth in arch.arch.teeth])
    lower = fdi >= 30
    position = fdi % 10
    smooth = _Smooth(place, spreads)

    # Level and inclination follow the surface on which both arches meet; its normal points to the lower teeth's tips.
    meets = np.where(lower, 1.0, -1.0)
    rolls = np.where(lower & (position > 3), -1.0, 1.0)
    turn = np.radians(spreads.turn_deg) * np.stack(
        [
            rolls * smooth.draw(count, rng),
            meets * smooth.draw(count, rng),
            rng.standard_normal((count, len(fdi))),
        ],
        -1,
    )
    shift = np.zeros((count, len(fdi), 3))
    shift[..., 1] = spreads.shift_mm * smooth.draw(count, rng)
    shift[..., 2] = spreads.shift_mm * meets * smooth.draw(count, rng)
    crowded = spreads.crowding_mm * np.abs(rng.standard_normal((count, 2)))[:, lower.astype(int)]
    alternating = np.select([position == 2, position <= 3], [-1.0, 1.0], 0.0)
    shift[..., 1] += crowded * alternating
    turn[..., 2] += np.radians(_CROWDED_TURN_DEG) * crowded * alternating
    front = np.cos(np.clip(np.abs(place) / 28e-3, 0, 1) * np.pi / 2) ** 2
    jet = rng.standard_normal((count, 1))
    bite = spreads.overlap_overjet * jet + np.sqrt(1 - spreads.overlap_overjet**2) * rng.standard_normal((count, 1))
    shift[..., 1] += np.where(lower, -0.5, 0.5) * spreads.overjet_mm * jet * front
    shift[..., 2] += 0.5 * spreads.overbite_mm * bite * front
    scale = 1 + spreads.size * _sizes(fdi, count, rng)
    wear = spreads.wear_mm * np.abs(rng.standard_normal((count, 1))) * rng.uniform(0.5, 1, (count, len(fdi)))
    gone = _gone(fdi, spreads.missing, count, rng)
    arch = spreads.arch * rng.standard_normal((count, 2))
    poses, start = [], 0
    for number, rig in enumerate(dentition.arches):
        rows = slice(start, start + len(rig.teeth))
        start += len(rig.teeth)
        own = spreads.arch * rng.standard_normal((count, 2))
        factor = 1 + np.sqrt(1 - spreads.jaws**2) * arch + spreads.jaws * own
        moved = np.zeros((count, 3))
        moved[:, 2] = -dentition.lowered * number
        teeth = [
            ToothPose(
                turn=turn[:, k],
                shift=1e-3 * shift[:, k],
                scale=scale[:, k],
                wear=1e-3 * wear[:, k],
                kept=np.where(gone[:, k, None], _LEFT_OUT, 1.0),
            )
            for k in range(rows.start, rows.stop)
        ]
        gaps = 1e-3 * spreads.gap_mm * np.abs(rng.standard_normal((count, len(rig.teeth))))
        poses.append(ArchPose(width=factor[:, 0], length=factor[:, 1], shift=moved, teeth=teeth, gaps=gaps))
    return poses


class _Smooth:
    """Deviations of unit variance that teeth share with those near them, in both arches."""

    def __init__(self, place: Float[np.ndarray, "T"], spreads: Spreads):
        apart = (place[:, None] - place) / (1e-3 * spreads.reach_mm)
        covariance = spreads.shared * np.exp(-(apart**2) / 2) + (1 - spreads.shared) * np.eye(len(place))
        self._root = np.linalg.cholesky(covariance + 1e-9 * np.eye(len(place)))

    def draw(self, count: int, rng: np.random.Generator) -> Float[np.ndarray, "S T"]:
        return rng.standard_normal((count, len(self._root))) @ self._root.T


def _sizes(fdi: Int[np.ndarray, "T"], count: int, rng: np.random.Generator) -> Float[np.ndarray, "S T 3"]:
    """Sizes of unit variance: a part of all teeth, of the teeth of one kind in both jaws, of a pair, of the tooth."""
    position, jaw = fdi % 10, fdi >= 30
    all_teeth = rng.standard_normal((count, 1, 3))
    kind = rng.standard_normal((count, 9, 3))[:, position]
    pair = rng.standard_normal((count, 18, 3))[:, position + 9 * jaw]
    own = rng.standard_normal((count, len(fdi), 3))
    drawn: np.ndarray = np.sqrt(0.45) * all_teeth + np.sqrt(0.25) * kind + np.sqrt(0.2) * pair + np.sqrt(0.1) * own
    return drawn


def _gone(fdi: Int[np.ndarray, "T"], share: float, count: int, rng: np.random.Generator) -> Bool[np.ndarray, "S T"]:
    """Which tooth each sample lacks: at most one."""
    weights = np.array([_MISSING.get(int(number), 0.0) for number in fdi])
    which = rng.choice(len(fdi), count, p=weights / weights.sum())
    gone = np.zeros((count, len(fdi)), bool)
    rows = np.flatnonzero(rng.uniform(size=count) < share)
    gone[rows, which[rows]] = True
    return gone
