"""The regional stage of stabilization: principal components per region over all samples, and scores of how similar each
is to a motion of the whole head [GNM, Head Expression]; docs/algorithms.md, "Stabilization"."""

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float, Int

from registration.errors import InputError
from registration.frames import MM_PER_M
from registration.geometry.pca import principal_components
from registration.geometry.rigid import align, fit_twists, motion_fields
from registration.geometry.topology import vertex_areas
from registration.model import regions
from registration.model.gnm_npz import GNMData
from registration.stabilize.subject_meshes import SkullSkin

MIN_SAMPLES = 2


@dataclass(frozen=True, kw_only=True)
class RegionalSettings:
    """Settings of the regional stage (docs/algorithms.md, "Stabilization")."""

    variance_ratio: float = 0.99  # fraction of a region's energy in the components that are computed
    rigidity: float = 0.5  # a flagged component has more than this,
    label_independence: float = 0.7  # more than this,
    shared_motion: float = 0.5  # and at least this


@dataclass(frozen=True, kw_only=True)
class HeadGeometry:
    """Template, skin areas and regions of a model in the head frame: metres, axes of the model, origin at `centre`."""

    data: GNMData
    points: Float[np.ndarray, "V 3"]  # the template
    centre: Float[np.ndarray, "3"]  # mean of the exterior skin's vertices, in the model's frame
    area: Float[np.ndarray, "V"]  # m^2, of the exterior skin; 0 elsewhere
    regions: dict[str, Int[np.ndarray, "_"]]  # vertex rows

    @classmethod
    def from_model(cls, data: GNMData) -> "HeadGeometry":
        """Compute areas and regions of a model.

        Args:
            data: a model in this project's format.

        Returns:
            The geometry of its template.

        Raises:
            InputError: a vertex group of a region is missing; the message names it.
        """
        masks = regions.stabilization_regions(data)
        exterior = regions.exterior(data)
        template = data.template_vertex_positions.astype(np.float64)
        centre = template[exterior].mean(0)
        area = vertex_areas(template, data.triangles) * exterior
        rows = {name: np.flatnonzero(mask) for name, mask in masks.items()}
        return cls(data=data, points=template - centre, centre=centre, area=area, regions=rows)

    def T_head_world(self, neutral: Float[np.ndarray, "V 3"], skin: SkullSkin) -> Float[np.ndarray, "4 4"]:
        """Align a neutral with the template by the skin on the skull; rigid, without scale.

        Args:
            neutral: metres, its capture's world.
            skin: weights of the vertices.

        Returns:
            p_head = T_head_world @ p_world.
        """
        return align(neutral[None], self.points, skin.area[None])[0]


@dataclass(frozen=True, kw_only=True)
class RegionalComponents:
    """K principal components of the displacements in one region (R vertices) over S samples, the strongest first.

    A sample's displacement in the region is approximately `coefficients @ modes`. The vertex weights are areas only,
    without those of the automatic stage: motion that its weights hide must be visible here. With equal weights in
    decomposition and rigid fit, `rigid_size_ratio` is the square root of `rigid_fit_r2`.
    """

    region: str
    rows: Int[np.ndarray, "R"]
    modes: Float[np.ndarray, "K R 3"]  # metres per unit coefficient, which is one standard deviation
    coefficients: Float[np.ndarray, "S K"]
    energy: Float[np.ndarray, "K"]  # fraction of the region's
    twists: Float[np.ndarray, "K 6"]  # rigid part of each mode about the head's centre, radians and metres
    rigid_fit_r2: Float[np.ndarray, "K"]  # fraction of the mode's energy in its rigid part
    rigid_size_ratio: Float[np.ndarray, "K"]  # length of the rigid part over the length of the mode
    label_independence: Float[np.ndarray, "K"]  # fraction of the coefficients' variance that labels do not explain
    shared_motion: Float[np.ndarray, "K"]  # similarity to the motions of nose and neck, the lesser; 1: equal
    flagged: Bool[np.ndarray, "K"]
    reference_twists: Float[np.ndarray, "2 K 6"]  # motions of nose and neck per unit coefficient

    @cached_property
    def rigidity(self) -> Float[np.ndarray, "K"]:
        """Return the rigid fit times the rigid size, which counts at most 1."""
        return self.rigid_fit_r2 * np.minimum(1, self.rigid_size_ratio)

    def rigid_rms_mm(self, head: HeadGeometry) -> Float[np.ndarray, "K"]:
        """Return the rms displacement of the region by the rigid part of one standard deviation, mm."""
        area = head.area[self.rows]
        rigid = np.einsum("kj,jrc->krc", self.twists, motion_fields(head.points[self.rows]))
        return MM_PER_M * np.sqrt(_energy(rigid, area) / area.sum())


def regional_components(
    displacements: Iterable[Float[np.ndarray, "V 3"]],
    labels: Sequence[str],
    head: HeadGeometry,
    settings: RegionalSettings | None = None,
) -> list[RegionalComponents]:
    """Compute uncentred principal components of every region, and their scores.

    Args:
        displacements: of all subjects' stabilized expressions from their neutrals, in the head frame, metres, one
            array per sample. Iterated several times; a matrix as large as one region's part of all samples is held
            in memory, at most its square.
        labels: the expression of each sample.
        head: regions of the model.
        settings: None: the defaults.

    Returns:
        The components of each region of `head`.

    Raises:
        InputError: fewer than two samples, or numbers that are not finite.
    """
    settings = settings or RegionalSettings()
    _check(displacements, labels)
    references = [_region_twists(displacements, head.regions[name], head) for name in regions.REFERENCE_REGIONS]
    return [_components(displacements, labels, name, references, head, settings) for name in head.regions]


def label_effects(coefficients: Float[np.ndarray, "S K"], labels: Sequence[str]) -> Float[np.ndarray, "S K"]:
    """Estimate the part of each coefficient that the label explains: the label's mean, shrunk by its sampling error.

    One-way random effects (empirical Bayes): the variances between and within labels are estimated from the mean
    squares. For a coefficient that does not depend on the label the part is small; with one sample per label it is the
    whole coefficient.

    Args:
        coefficients: of K components in S samples.
        labels: of the samples.

    Returns:
        For each sample the effect of its label; zeros if all labels are equal.
    """
    group, means, counts, within = _by_label(coefficients, labels)
    sample_count, label_count = len(group), len(counts)
    if label_count < 2:
        return np.zeros_like(coefficients)
    mean_square = (counts[:, None] * (means - coefficients.mean(0)) ** 2).sum(0) / (label_count - 1)
    within_variance = within / max(sample_count - label_count, 1)
    typical_count = (sample_count - (counts**2).sum() / sample_count) / (label_count - 1)
    between_variance = np.maximum(mean_square - within_variance, 0) / typical_count
    variance = between_variance + within_variance / counts[:, None]  # of each label's mean
    return (means * np.divide(between_variance, variance, out=np.zeros_like(means), where=variance > 0))[group]


def label_independence(coefficients: Float[np.ndarray, "S K"], labels: Sequence[str]) -> Float[np.ndarray, "K"]:
    """Return the fraction of variance that labels do not explain: 1 - epsilon^2 [Kelley 1935].

    Unlike 1 - eta^2, which falls with the number of labels even if nothing depends on them, it is then 1 on average.

    Args:
        coefficients: of K components in S samples.
        labels: of the samples.

    Returns:
        At most 1; 0 with one sample per label, where it is undefined.
    """
    group, _, counts, within = _by_label(coefficients, labels)
    sample_count, label_count = len(group), len(counts)
    total = ((coefficients - coefficients.mean(0)) ** 2).sum(0)
    if sample_count == label_count:
        return np.zeros(coefficients.shape[1])
    return np.minimum(1, within / np.where(total > 0, total, 1) * (sample_count - 1) / (sample_count - label_count))


def _check(displacements: Iterable[Float[np.ndarray, "V 3"]], labels: Sequence[str]) -> None:
    if len(labels) < MIN_SAMPLES:
        raise InputError(
            "There are too few samples for principal components",
            where="expressions of all subjects",
            expected=f"at least {MIN_SAMPLES}, better several per label",
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
                fix="register it again, or exclude it",
            )


def _components(
    displacements: Iterable[Float[np.ndarray, "V 3"]],
    labels: Sequence[str],
    region: str,
    reference_motions: list[Float[np.ndarray, "S 6"]],
    head: HeadGeometry,
    settings: RegionalSettings,
) -> RegionalComponents:
    rows = head.regions[region]
    area, points = head.area[rows], head.points[rows]
    root_area = np.sqrt(area)[:, None]
    weighted = _RegionData(displacements, rows, root_area)
    principal = principal_components(
        weighted, centred=False, variance_ratio=settings.variance_ratio, memory_gb=math.inf
    )
    flat, coefficients = principal.components, principal.coefficients(weighted)
    energy = principal.variance / (principal.total or 1)
    modes = flat.reshape(len(flat), len(rows), 3) / root_area
    twists = fit_twists(modes, points, area)
    # Coefficients of different components are uncorrelated: each regression is a product with its own coefficients.
    reference_twists = np.stack([coefficients.T @ motion / len(labels) for motion in reference_motions])
    fields = motion_fields(points)
    rigid, reference = (np.tensordot(twist, fields, 1) for twist in (twists, reference_twists))
    mode_energy, residual_energy = _energy(modes, area), _energy(modes - rigid, area)
    mode_energy = np.where(mode_energy > 0, mode_energy, 1)
    energy_sum = _energy(rigid, area) + _energy(reference, area)
    products = np.einsum("krc,nkrc,r->nk", rigid, reference, area)
    similarity = 2 * products / np.where(energy_sum > 0, energy_sum, 1)
    independence, shared_motion = label_independence(coefficients, labels), similarity.min(0)
    fit_r2, size_ratio = 1 - residual_energy / mode_energy, np.sqrt(_energy(rigid, area) / mode_energy)
    flagged = fit_r2 * np.minimum(1, size_ratio) > settings.rigidity
    flagged &= (independence > settings.label_independence) & (shared_motion >= settings.shared_motion)
    return RegionalComponents(
        region=region,
        rows=rows,
        modes=modes,
        coefficients=coefficients,
        energy=energy,
        twists=twists,
        rigid_fit_r2=fit_r2,
        rigid_size_ratio=size_ratio,
        label_independence=independence,
        shared_motion=shared_motion,
        flagged=flagged,
        reference_twists=reference_twists,
    )


class _RegionData:
    """The displacements in a region times the root of the vertex area, flat; iterable several times."""

    def __init__(self, displacements: Iterable[np.ndarray], rows: np.ndarray, root_area: np.ndarray):
        self._displacements, self._rows, self._root_area = displacements, rows, root_area

    def __iter__(self) -> Iterator[np.ndarray]:
        return ((displacement[self._rows] * self._root_area).ravel() for displacement in self._displacements)


def _region_twists(
    displacements: Iterable[np.ndarray], rows: Int[np.ndarray, "R"], head: HeadGeometry
) -> Float[np.ndarray, "S 6"]:
    """Return the rigid motion of a region in every sample, radians and metres."""
    in_region = np.stack([np.asarray(displacement[rows], np.float32) for displacement in displacements])
    return fit_twists(in_region, head.points[rows], head.area[rows])


def _energy(field: Float[np.ndarray, "*K R 3"], area: Float[np.ndarray, "R"]) -> Float[np.ndarray, "*K"]:
    return np.asarray((field**2).sum(-1) @ area)


def _by_label(
    coefficients: Float[np.ndarray, "S K"], labels: Sequence[str]
) -> tuple[Int[np.ndarray, "S"], Float[np.ndarray, "L K"], Int[np.ndarray, "L"], Float[np.ndarray, "K"]]:
    """Return each sample's label index, the labels' means and counts, and the sum of squares about the means."""
    _, group, counts = np.unique(np.asarray(labels), return_inverse=True, return_counts=True)
    means = np.zeros((len(counts), coefficients.shape[1]))
    np.add.at(means, group, coefficients)
    means /= counts[:, None]
    return group, means, counts, ((coefficients - means[group]) ** 2).sum(0)
