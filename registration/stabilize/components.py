"""The regional stage's view of a dataset: principal components per region, and how much each looks like motion of the
whole head [GNM, Head Expression]; docs/algorithms.md, "Stabilization"."""

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float, Int

from registration.errors import InputError
from registration.geometry.pca import principal_components
from registration.geometry.rigid import align, fit_twists, motion_fields
from registration.geometry.topology import vertex_areas
from registration.model import regions
from registration.model.gnm_npz import GNMData
from registration.stabilize.subject_meshes import SkullSkin

LEAST_SAMPLES = 2


@dataclass(frozen=True, kw_only=True)
class Regional:
    """How the stage goes about it (docs/algorithms.md, "Stabilization")."""

    share: float = 0.99  # of a region's energy, held by the components that are looked at
    rigid: float = 0.5  # flagged: `score` above this,
    free: float = 0.7  # `free_of_label` above this,
    shared: float = 0.5  # and `shared` of at least this


@dataclass(frozen=True, kw_only=True)
class Head:
    """The regions of one model, in whose frame displacements are: metres, the origin amid the skin."""

    data: GNMData
    points: Float[np.ndarray, "V 3"]  # of the template, about `centre`
    centre: Float[np.ndarray, "3"]
    area: Float[np.ndarray, "V"]  # m^2, of the exterior skin; 0 elsewhere
    regions: dict[str, Int[np.ndarray, "_"]]  # rows

    @classmethod
    def of(cls, data: GNMData) -> "Head":
        """Raises InputError, naming it, if a source group of a region is missing."""
        masks = regions.stabilization_regions(data)
        exterior = regions.exterior(data)
        template = data.template_vertex_positions.astype(np.float64)
        centre = template[exterior].mean(0)
        area = vertex_areas(template, data.triangles) * exterior
        rows = {name: np.flatnonzero(mask) for name, mask in masks.items()}
        return cls(data=data, points=template - centre, centre=centre, area=area, regions=rows)

    def T_head_world(self, neutral: Float[np.ndarray, "V 3"], skin: SkullSkin) -> Float[np.ndarray, "4 4"]:
        """Lays a neutral (its capture's world) onto the template, by the skin on the skull: never scaled."""
        return align(neutral[None], self.points, skin.area[None])[0]


@dataclass(frozen=True, kw_only=True)
class Components:
    """K components of one region's displacements over S samples, the strongest first.

    A sample's displacement there is nearly `coefficients @ modes`. The weights are areas alone, and not the automatic
    stage's: what its weights overlook, these may see. With the same weights in both, S2 is the root of S1.
    """

    region: str
    rows: Int[np.ndarray, "R"]
    modes: Float[np.ndarray, "K R 3"]  # metres, for a coefficient of one, which is one standard deviation
    coefficients: Float[np.ndarray, "S K"]
    energy: Float[np.ndarray, "K"]  # share of the region's
    twists: Float[np.ndarray, "K 6"]  # of the rigid part of each mode about the head's centre, radians and metres
    rigid_share: Float[np.ndarray, "K"]  # S1: of the mode's energy, in its rigid part
    rigid_size: Float[np.ndarray, "K"]  # S2: the rigid part's length over the mode's
    free_of_label: Float[np.ndarray, "K"]  # S3: of the coefficients' variance, what labels do not explain
    shared: Float[np.ndarray, "K"]  # S5: likeness to how nose and neck move along, the lesser; 1: the same, <= 0: none
    flagged: Bool[np.ndarray, "K"]
    steady_twists: Float[np.ndarray, "2 K 6"]  # how nose, neck move along with a coefficient of one

    @cached_property
    def score(self) -> Float[np.ndarray, "K"]:
        """S = S1 min(1, S2)."""
        return self.rigid_share * np.minimum(1, self.rigid_size)

    def rigid_rms_mm(self, head: Head) -> Float[np.ndarray, "K"]:
        """How far the rigid part of one standard deviation moves the region, rms."""
        area = head.area[self.rows]
        moved = np.einsum("kj,jrc->krc", self.twists, motion_fields(head.points[self.rows]))
        return 1e3 * np.sqrt(_energy(moved, area) / area.sum())


def regional_components(
    displacements: Iterable[Float[np.ndarray, "V 3"]],
    labels: Sequence[str],
    head: Head,
    settings: Regional | None = None,
) -> list[Components]:
    """Uncentred principal components of every region, and their scores.

    Args:
        displacements: of all subjects' stabilized expressions from their neutrals, in the head's frame, metres, one
            array a sample. Read several times; a region's part is held in memory, at most its square.
        labels: what was performed in each sample.

    Raises:
        InputError: fewer than two samples, or numbers that are not finite.
    """
    settings = settings or Regional()
    _check(displacements, labels)
    steady = [_twists(displacements, head.regions[name], head) for name in regions.REFERENCE_REGIONS]
    return [_components(displacements, labels, name, steady, head, settings) for name in head.regions]


def label_part(coefficients: Float[np.ndarray, "S K"], labels: Sequence[str]) -> Float[np.ndarray, "S K"]:
    """What the label explains of each coefficient: each label's mean, shrunk by how far chance would take it.

    One-way random effects (empirical Bayes): variances between and within labels are taken from the mean squares. A
    coefficient that does not depend on the label has no such part; with one sample a label it is all of it.
    """
    group, means, counts, within = _by_label(coefficients, labels)
    samples, kinds = len(group), len(counts)
    if kinds < 2:
        return np.zeros_like(coefficients)
    between = (counts[:, None] * (means - coefficients.mean(0)) ** 2).sum(0) / (kinds - 1)
    chance = within / max(samples - kinds, 1)
    typical = (samples - (counts**2).sum() / samples) / (kinds - 1)
    own = np.maximum(between - chance, 0) / typical
    spread = own + chance / counts[:, None]
    return (means * np.divide(own, spread, out=np.zeros_like(means), where=spread > 0))[group]


def free_of_label(coefficients: Float[np.ndarray, "S K"], labels: Sequence[str]) -> Float[np.ndarray, "K"]:
    """S3: one minus the share of variance that labels explain, corrected for what chance lets them explain.

    1 - eta^2 falls with the number of labels though nothing depends on them: here it is
    1 - epsilon^2 (Kelley 1935), 1 on average then. With one sample a label nothing can be told: 0.
    """
    group, _, counts, within = _by_label(coefficients, labels)
    samples, kinds = len(group), len(counts)
    total = ((coefficients - coefficients.mean(0)) ** 2).sum(0)
    if samples == kinds:
        return np.zeros(coefficients.shape[1])
    return np.minimum(1, within / np.where(total > 0, total, 1) * (samples - 1) / (samples - kinds))


def _check(displacements: Iterable[Float[np.ndarray, "V 3"]], labels: Sequence[str]) -> None:
    if len(labels) < LEAST_SAMPLES:
        raise InputError(
            "There are too few samples for principal components",
            where="expressions of all subjects",
            expected=f"at least {LEAST_SAMPLES}, better some for each label",
            got=len(labels),
            fix="add expressions, or use the automatic stage alone (`stabilize_subject`)",
        )
    for number, displacement in enumerate(displacements):
        if not np.isfinite(displacement).all():
            raise InputError(
                "A sample is not finite",
                where=f"displacement {number}, {labels[number]}",
                expected="finite numbers",
                got=f"{np.count_nonzero(~np.isfinite(displacement))} NaN or infinite",
                fix="register it again, or leave it out",
            )


def _components(
    displacements: Iterable[Float[np.ndarray, "V 3"]],
    labels: Sequence[str],
    region: str,
    steady: list[Float[np.ndarray, "S 6"]],
    head: Head,
    settings: Regional,
) -> Components:
    rows = head.regions[region]
    area, points = head.area[rows], head.points[rows]
    root = np.sqrt(area)[:, None]
    parts = _Parts(displacements, rows, root)
    principal = principal_components(parts, centred=False, variance_ratio=settings.share, memory_gb=math.inf)
    flat, coefficients = principal.components, principal.coefficients(parts)
    energy = principal.variance / (principal.total or 1)
    modes = flat.reshape(len(flat), len(rows), 3) / root
    twists = fit_twists(modes, points, area)
    # Coefficients of one component do not go with another's: their regressions are independent.
    along = np.stack([coefficients.T @ motion / len(labels) for motion in steady])
    fields = motion_fields(points)
    rigid, others = (np.tensordot(twist, fields, 1) for twist in (twists, along))
    size, left = _energy(modes, area), _energy(modes - rigid, area)
    size = np.where(size > 0, size, 1)
    both = _energy(rigid, area) + _energy(others, area)
    likeness = 2 * np.einsum("krc,nkrc,r->nk", rigid, others, area) / np.where(both > 0, both, 1)
    free = free_of_label(coefficients, labels)
    share, length, shared = 1 - left / size, np.sqrt(_energy(rigid, area) / size), likeness.min(0)
    score = share * np.minimum(1, length)
    return Components(
        region=region,
        rows=rows,
        modes=modes,
        coefficients=coefficients,
        energy=energy,
        twists=twists,
        rigid_share=share,
        rigid_size=length,
        free_of_label=free,
        shared=shared,
        flagged=(score > settings.rigid) & (free > settings.free) & (shared >= settings.shared),
        steady_twists=along,
    )


class _Parts:
    """The part of every displacement that lies in a region, times the root of the area: to be read again and again."""

    def __init__(self, displacements: Iterable[np.ndarray], rows: np.ndarray, root: np.ndarray):
        self._displacements, self._rows, self._root = displacements, rows, root

    def __iter__(self) -> Iterator[np.ndarray]:
        return ((displacement[self._rows] * self._root).ravel() for displacement in self._displacements)


def _twists(displacements: Iterable[np.ndarray], rows: Int[np.ndarray, "R"], head: Head) -> Float[np.ndarray, "S 6"]:
    """The rigid motion of a region in every sample."""
    parts = np.stack([np.asarray(displacement[rows], np.float32) for displacement in displacements])
    return fit_twists(parts, head.points[rows], head.area[rows])


def _energy(field: Float[np.ndarray, "*K R 3"], area: Float[np.ndarray, "R"]) -> Float[np.ndarray, "*K"]:
    return np.asarray((field**2).sum(-1) @ area)


def _by_label(
    coefficients: Float[np.ndarray, "S K"], labels: Sequence[str]
) -> tuple[Int[np.ndarray, "S"], Float[np.ndarray, "L K"], Int[np.ndarray, "L"], Float[np.ndarray, "K"]]:
    """Each sample's label as a number, means and counts of labels, and the sum of squares about the means."""
    _, group, counts = np.unique(np.asarray(labels), return_inverse=True, return_counts=True)
    means = np.zeros((len(counts), coefficients.shape[1]))
    np.add.at(means, group, coefficients)
    means /= counts[:, None]
    return group, means, counts, ((coefficients - means[group]) ** 2).sum(0)
