"""Eyeballs between their eyelids: placement in a new template, and motion with every identity component
[GNM, Head Identity]; docs/algorithms.md, "Eyeballs and eyelids"."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float, Int

from registration.frames import MM_PER_M
from registration.geometry.closest_point import ClosestPointQuery, barycentric_points
from registration.geometry.extrapolation import extrapolate
from registration.model import regions
from registration.model.gnm_npz import GNMData

BOUND = 3.0  # standard deviations, both signs, at which components are evaluated
_RIM_M = 2e-3  # maximum distance of the rim of the lids from the eyeball
_FADE_M = 2e-3  # distance over which a correction of the rim fades into the surrounding skin
_MAX_ITERATIONS = 5
_TOLERANCE_M = 1e-8


@dataclass(frozen=True, kw_only=True, eq=False)
class EyelidRim:
    """One eyeball of a template, and the rim of the lids about it. Metres."""

    ball: Int[np.ndarray, "B"]  # all its vertices
    shell: Float[np.ndarray, "S 3"]  # the template; `triangles` select the eyeball's outer surface
    triangles: Int[np.ndarray, "T 3"]
    rim: Int[np.ndarray, "R"]
    gap: Float[np.ndarray, "R"]  # signed distance of the rim from the shell in the template, positive outside

    @cached_property
    def _query(self) -> ClosestPointQuery:
        return ClosestPointQuery(self.shell, self.triangles)

    def gaps(
        self, rim: Float[np.ndarray, "R 3"], translation: Float[np.ndarray, "3"]
    ) -> tuple[Float[np.ndarray, "R"], Float[np.ndarray, "R 3"]]:
        """Return signed distances of points from the translated shell, and the unit directions of their growth."""
        points = np.asarray(rim, np.float64) - translation
        distance, face, barycentric = self._query.closest(points)
        a, b, c = (self.shell[self.triangles[face, k]] for k in range(3))
        normal = np.cross(b - a, c - a)
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        difference = points - barycentric_points(self.shell, self.triangles, face, barycentric)
        sign = np.where((difference * normal).sum(1) < 0, -1.0, 1.0)
        # On the surface itself the distance grows along the normal.
        touching = (distance < 1e-9)[:, None]
        direction = np.where(touching, normal, difference * (sign / np.maximum(distance, 1e-12))[:, None])
        return sign * distance, direction

    def best_translation(self, rims: list[Float[np.ndarray, "R 3"]], signs: list[float]) -> Float[np.ndarray, "3"]:
        """Return t for which the gaps of each rim from the shell, translated by sign * t, change least (Gauss-Newton).

        Args:
            rims: positions of the rim.
            signs: one a rim.
        """
        t = np.zeros(3)
        for _ in range(_MAX_ITERATIONS):
            left, right = [], []
            for rim, sign in zip(rims, signs, strict=True):
                gap, direction = self.gaps(rim, sign * t)
                left.append(sign * direction)
                right.append(gap - self.gap)
            step = np.linalg.lstsq(np.concatenate(left), np.concatenate(right), rcond=None)[0]
            t = t + step
            if np.abs(step).max() < _TOLERANCE_M:
                break
        return t


def eyelid_rims(data: GNMData) -> tuple[EyelidRim, EyelidRim]:
    """Return the left eye's and the right eye's rim in a model's template.

    Raises:
        InputError: the model has no vertex groups of eyes.
    """
    template, exterior = data.template_vertex_positions.astype(np.float64), regions.exterior(data)
    rims = []
    for ball, shell in zip(regions.eyeballs(data), regions.eyeball_shells(data), strict=True):
        fields = {
            "ball": np.flatnonzero(ball),
            "shell": template,
            "triangles": data.triangles[shell[data.triangles].all(1)].astype(np.int64),
        }
        center = template[shell].mean(0)
        radius = np.linalg.norm(template[shell] - center, axis=1).max() + _RIM_M
        near = np.flatnonzero(exterior & (np.linalg.norm(template - center, axis=1) < radius))
        eyeball = EyelidRim(rim=np.zeros(0, int), gap=np.zeros(0), **fields)
        gap, _ = eyeball.gaps(template[near], np.zeros(3))
        on_rim = np.abs(gap) < _RIM_M
        rims.append(EyelidRim(rim=near[on_rim], gap=gap[on_rim], **fields))
    return rims[0], rims[1]


def eyeball_placement(eyelids: EyelidRim, template: Float[np.ndarray, "V 3"]) -> Float[np.ndarray, "3"]:
    """Return the eyeball's translation from the rim's own template into a new one, metres."""
    return eyelids.best_translation([template[eyelids.rim]], [1.0])


def eyeball_motion(
    eyelids: EyelidRim, template: Float[np.ndarray, "V 3"], basis: Float[np.ndarray, "K V 3"]
) -> Float[np.ndarray, "K 3"]:
    """Return the eyeball's translation per unit of each coefficient: gaps at +-BOUND change least. Metres.

    Args:
        eyelids: of `template`, in which the eyeball has been placed.
        template: vertices.
        basis: identity components.
    """
    rest = template[eyelids.rim]
    motions = BOUND * basis[:, eyelids.rim].astype(np.float64)
    best = [eyelids.best_translation([rest + motion, rest - motion], [1.0, -1.0]) / BOUND for motion in motions]
    return np.stack(best).reshape(-1, 3)


def eyelids_on_eyeballs(
    both: tuple[EyelidRim, EyelidRim],
    data: GNMData,
    template: Float[np.ndarray, "V 3"],
    basis: Float[np.ndarray, "K V 3"],
    motions: Float[np.ndarray, "K 2 3"],
) -> Float[np.ndarray, "K V 3"]:
    """Return the basis with eyelids that stay on the eyeballs, to first order in the coefficient.

    No translation of an eyeball fits the whole rim. The remaining difference between the gaps at +-BOUND is removed
    along the gaps' directions and fades into the surrounding skin. What remains is of second order: lids that slide
    along the eyeball. [GNM] has no such correction.

    Args:
        both: rims of `template`.
        data: a model of the same topology.
        template: vertices, metres.
        basis: identity components, metres.
        motions: of the eyeballs with each component, metres.
    """
    on_rim = np.zeros(len(template), bool)
    corrections = np.zeros((len(template), len(basis), 3))
    for side, eyelids in enumerate(both):
        on_rim[eyelids.rim] = True
        rest = template[eyelids.rim]
        _, outward = eyelids.gaps(rest, np.zeros(3))
        for k, motion in enumerate(BOUND * basis[:, eyelids.rim].astype(np.float64)):
            positive, _ = eyelids.gaps(rest + motion, BOUND * motions[k, side])
            negative, _ = eyelids.gaps(rest - motion, -BOUND * motions[k, side])
            corrections[eyelids.rim, k] = -((positive - negative) / (2 * BOUND))[:, None] * outward
    flat = corrections.reshape(len(template), -1)
    change = extrapolate(flat, on_rim, data.triangles, template, reach_m=_FADE_M)
    change[~regions.skin(data)] = 0
    return basis + change.reshape(len(template), len(basis), 3).swapaxes(0, 1)


def gap_change_mm(
    both: tuple[EyelidRim, EyelidRim], template: Float[np.ndarray, "V 3"], basis: Float[np.ndarray, "K V 3"]
) -> Float[np.ndarray, "K"]:
    """Return the mean change of the gaps with each component at +-BOUND, mm: the maximum over eyes and signs.

    0 for an eyeball without a rim. `both` are of that template; `basis` moves the eyeballs too.
    """
    changes = np.zeros((len(basis), 2, 2))
    for side, eyelids in enumerate(both):
        if not len(eyelids.rim):
            continue
        rest = template[eyelids.rim]
        for k, component in enumerate(BOUND * basis.astype(np.float64)):
            translation = component[eyelids.ball].mean(0)
            for sign in (1, -1):
                gap, _ = eyelids.gaps(rest + sign * component[eyelids.rim], sign * translation)
                changes[k, side, (sign + 1) // 2] = MM_PER_M * np.abs(gap - eyelids.gap).mean()
    return changes.max((1, 2), initial=0)
