"""Identity basis: centred principal components of aligned neutral heads, shrunk towards a prior model
[GNM, Head Identity]; docs/algorithms.md, "Covariance shrinkage"."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float, Int

from coregister.next_model import eyelids
from coregister.next_model.shrinkage import (
    SHRINKAGE_GRID,
    SampleParts,
    ShrunkCovariance,
    cross_validated_shrinkage,
)
from coregister.region_masks import FLIP, mirrored
from registration.errors import InputError
from registration.geometry import pca
from registration.geometry.rigid import fit_twists, motion_fields
from registration.geometry.topology import vertex_areas, vertex_normals
from registration.model import regions
from registration.model.gnm_npz import GNMData
from registration.stabilize.subject_meshes import SkullSkin

_FALLBACK_SHRINKAGE = 0.2  # where there are too few heads to cross-validate
_MIN_HEADS = 3  # for cross-validation
_COORDINATES = 400  # at least, in which cross-validation compares models
_COMPARED_COMPONENTS = 20  # of the models that cross-validation compares, unless `max_components` says
_ORAL_WEIGHT = 1e-3  # of teeth and tongue in the components: neutrals mostly occlude them


@dataclass(frozen=True, kw_only=True)
class IdentitySettings:
    """Settings of the identity basis.

    Attributes:
        variance_ratio: fraction of the variance that the components must explain, at least.
        max_components: of the basis; None: as many as `variance_ratio` needs.
        shrinkage: fraction of the variance from the prior model, 0 to 1; None: the value with the smallest residual
            of excluded subjects (`shrinkage.cross_validated_shrinkage`).
        by_area: weight vertices by area instead of equally.
        along_skin: weight of displacement along the skin, relative to displacement across it: above 0, at most 1. A
            surface changes only by the latter, and registrations know the former less.
        mirrored: each head counts one half, its mirror image the other.
        eyelids_follow: keep the eyelids on the eyeballs, to first order (`eyelids.eyelids_on_eyeballs`).
    """

    variance_ratio: float = 0.999
    max_components: int | None = None
    shrinkage: float | None = None
    by_area: bool = True
    along_skin: float = 1.0
    mirrored: bool = True
    eyelids_follow: bool = True

    def __post_init__(self) -> None:
        """Refuse a metric in which displacements along the skin do not count at all.

        Raises:
            InputError: `along_skin` is out of range.
        """
        if not 0 < self.along_skin <= 1:
            raise InputError(
                "The weight along the skin is out of range",
                where="along_skin of the identity settings",
                expected="above 0, at most 1",
                got=self.along_skin,
                fix="give 1 for all directions alike, or less",
            )


@dataclass(frozen=True, kw_only=True, eq=False)
class IdentityBasis:
    """The template and K components; metres, the model's frame."""

    template: Float[np.ndarray, "V 3"]
    basis: Float[np.ndarray, "K V 3"]
    variance: Float[np.ndarray, "K"]  # of the skin, m^2 summed over its coordinates, before eyelids are corrected
    variance_ratio: float  # that the components explain
    shrinkage: float  # as used
    shrinkage_scores: Mapping[float, float]  # shrinkage -> rms residual of excluded heads, metres per vertex
    head_count: int
    mirrored: bool  # every head has its mirror image beside it
    method: str  # of the principal components
    missed: float  # fraction of the variance that as many other components could explain more, at most; 0: exact


def build_identity_basis(
    heads: Float[np.ndarray, "N V 3"],
    data: GNMData,
    settings: IdentitySettings | None = None,
    memory_gb: float = 4.0,
    prior: GNMData | None = None,
) -> IdentityBasis:
    """Return template and identity basis of aligned neutrals: components of skin, teeth and tongue, then eyeballs.

    The covariance is (1 - p) C + p (tr C / tr P) P (`ShrunkCovariance`): C of the heads about their mean, with N - 1;
    P = B'B of the prior model's identity components without the rigid motions that alignment removes from heads.

    With `settings.mirrored` the mean is symmetric, and C and P are half those of heads and components and half those of
    their mirror images, since asymmetry is equally likely in both directions. This equals the covariance of symmetric
    parts (about their mean, with N - 1) plus that of antisymmetric parts (about zero, which is known, with N). Every
    component is symmetric or antisymmetric.

    The template is the mean of the heads alone; eyeballs are placed between its eyelids. Teeth and tongue are used as
    registered, with almost no weight; only a first model places them by the lips [GNM, Initial Placement of Teeth and
    Tongue].

    Args:
        heads: aligned neutrals (`alignment.align_neutrals`), metres.
        data: the previous model.
        settings: of the basis.
        memory_gb: available for one covariance matrix, or for what replaces it.
        prior: the model to shrink towards, of the same topology, built from none of these heads: from one that was
            built from them, excluded heads would not be excluded, and the share chosen would climb from round to round.
            None: the previous one.

    Raises:
        InputError: the previous model has no vertex groups of eyes.
    """
    settings = settings or IdentitySettings()
    left, right = regions.eyeballs(data)
    rows = np.flatnonzero(~(left | right))
    mirror = data.mirror_indices[rows] if settings.mirrored else None
    metric = VertexMetric.of_template(data, settings, rows)
    head_mean = heads.mean(0, dtype=np.float64)
    mean = head_mean[rows] if mirror is None else (head_mean[rows] + head_mean[mirror] * FLIP) / 2
    components = _prior_components(data if prior is None else prior, rows, settings.mirrored)
    samples = _Samples(heads, rows, mirror, mean, metric, metric.scaled(components).reshape(len(components), -1))
    shrinkage, scores = _choose_shrinkage(samples, settings, int(regions.skin(data).sum()), memory_gb)
    covariance = samples.covariance(shrinkage)
    principal = pca.principal_components(
        covariance,
        centred=False,
        variance_ratio=settings.variance_ratio,
        max_components=settings.max_components,
        groups=samples.groups[: len(covariance)],
        memory_gb=memory_gb,
    )
    basis = np.zeros((len(principal.variance), *data.template_vertex_positions.shape))
    basis[:, rows] = metric.restored(principal.components.reshape(len(basis), len(rows), 3))
    template = data.template_vertex_positions.astype(np.float64)
    template[rows] = mean
    template, basis = _with_eyeballs(template, basis, data, settings.eyelids_follow)
    if settings.mirrored:
        template, basis = _symmetrized(template, basis, data)
    return IdentityBasis(
        template=template,
        basis=basis,
        variance=principal.variance,
        variance_ratio=principal.variance_ratio,
        shrinkage=covariance.shrinkage,
        shrinkage_scores=scores,
        head_count=len(heads),
        mirrored=settings.mirrored,
        method=principal.method,
        missed=principal.missed,
    )


def transfer_components(data: GNMData) -> Int[np.ndarray, "_"]:
    """Return the previous model's identity components that move no skin: eyes' and teeth's own shapes."""
    return np.flatnonzero(~_moves_skin(data))


def _moves_skin(data: GNMData) -> Bool[np.ndarray, "K"]:
    return np.abs(data.vertex_identity_basis[:, regions.skin(data)]).max(axis=(1, 2), initial=0) > 0


@dataclass(frozen=True, kw_only=True, eq=False)
class VertexMetric:
    """What displacements of R vertices count in the components: x' W x, W = s^2 (n n' + t^2 (I - n n')) for each.

    Coordinates W^(1/2) x have the usual length. With the scale s, the normal n and the weight t along the skin.
    """

    scale: Float[np.ndarray, "R 1"]
    normals: Float[np.ndarray, "R 3"]  # unit
    along: Float[np.ndarray, "R 1"]

    @classmethod
    def of_template(cls, data: GNMData, settings: IdentitySettings, rows: Int[np.ndarray, "R"]) -> "VertexMetric":
        """Return the metric of a model's template: of the outer skin by its normals, of other parts in all directions
        alike."""
        template = torch.from_numpy(data.template_vertex_positions.astype(np.float64))
        normals = vertex_normals(template, torch.from_numpy(data.triangles.astype(np.int64))).numpy()
        if settings.mirrored:  # symmetric, so that symmetric and antisymmetric displacements stay orthogonal
            normals = normals + normals[data.mirror_indices] * FLIP
            normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
        along = np.where(regions.exterior(data), settings.along_skin, 1.0)[:, None]
        return cls(scale=_vertex_scales(data, settings)[rows], normals=normals[rows], along=along[rows])

    def scaled(self, displacements: Float[np.ndarray, "*K R 3"]) -> Float[np.ndarray, "*K R 3"]:
        """Return W^(1/2) x."""
        return self._stretched(displacements, self.along) * self.scale

    def restored(self, scaled: Float[np.ndarray, "*K R 3"]) -> Float[np.ndarray, "*K R 3"]:
        """Return W^(-1/2) x."""
        return self._stretched(scaled, 1 / self.along) / self.scale

    def _stretched(
        self, x: Float[np.ndarray, "*K R 3"], along: Float[np.ndarray, "R 1"]
    ) -> Float[np.ndarray, "*K R 3"]:
        across = (x * self.normals).sum(-1, keepdims=True) * self.normals
        return across + along * (x - across)


def _vertex_scales(data: GNMData, settings: IdentitySettings) -> Float[np.ndarray, "V 1"]:
    """Square roots of the vertices' weights in the components."""
    skin = regions.skin(data)
    area = vertex_areas(data.template_vertex_positions, data.triangles) if settings.by_area else np.ones(len(skin))
    if settings.mirrored:
        area = (area + area[data.mirror_indices]) / 2
    mean = area[skin].mean()
    return (np.sqrt(np.maximum(area, 0.01 * mean) / mean) * np.where(skin, 1, _ORAL_WEIGHT))[:, None]


def _prior_components(data: GNMData, rows: Int[np.ndarray, "R"], both_parts: bool) -> Float[np.ndarray, "K R 3"]:
    """A model's components of the head in these rows, each without the rigid motion of the stable skin;
    with `both_parts` their symmetric and antisymmetric parts."""
    basis = data.vertex_identity_basis[_moves_skin(data)].astype(np.float64)
    stable = SkullSkin.from_model(data).area
    points = data.template_vertex_positions.astype(np.float64)
    points = points - stable @ points / stable.sum()
    basis -= np.tensordot(fit_twists(basis, points, stable), motion_fields(points), 1)
    if not both_parts:
        return basis[:, rows]
    mirror_images = mirrored(basis, data.mirror_indices)
    return np.concatenate([basis + mirror_images, basis - mirror_images])[:, rows] / 2


class _Samples:
    """Scaled deviations of heads from the mean in `rows`, and the prior's components; with `mirror`, symmetric, then
    antisymmetric parts of both."""

    def __init__(
        self,
        heads: Float[np.ndarray, "N V 3"],
        rows: Int[np.ndarray, "R"],
        mirror: Int[np.ndarray, "R"] | None,
        mean: Float[np.ndarray, "R 3"],
        metric: VertexMetric,
        prior: Float[np.ndarray, "K D"],
    ):
        self._heads, self._rows, self._mirror, self._mean, self._metric = heads, rows, mirror, mean, metric
        self.prior, self.head_count = prior, len(heads)
        parts = 1 if mirror is None else 2
        # Symmetric and antisymmetric parts are orthogonal.
        self.groups = np.concatenate(
            [np.repeat(np.arange(parts), n // parts) for n in (parts * len(heads), len(prior))]
        )

    def covariance(self, shrinkage: float) -> ShrunkCovariance:
        """Return the mixture of heads and prior."""
        count = self.head_count
        weights = np.ones(count) if self._mirror is None else np.repeat((1, 1 - 1 / count), count)
        return ShrunkCovariance(self, weights, count - 1, self.prior, shrinkage)

    def __iter__(self) -> Iterator[Float[np.ndarray, "D"]]:
        for sign in (0,) if self._mirror is None else (1, -1):
            for head in self._heads:
                yield self._metric.scaled(self._part(head, sign) - (self._mean if sign >= 0 else 0)).ravel()

    def _part(self, head: Float[np.ndarray, "V 3"], sign: int) -> Float[np.ndarray, "R 3"]:
        vertices = head[self._rows].astype(np.float64)
        return vertices if self._mirror is None else (vertices + sign * head[self._mirror] * FLIP) / 2


def _choose_shrinkage(
    samples: _Samples, settings: IdentitySettings, skin_count: int, memory_gb: float
) -> tuple[float, dict[float, float]]:
    """The shrinkage, and the scores it was chosen by.

    Models are compared in the coordinates of an even mixture's first components, many more than the models have.
    """
    if settings.shrinkage is not None:
        return settings.shrinkage, {}
    if samples.head_count < _MIN_HEADS or not samples.prior.any():
        return _FALLBACK_SHRINKAGE, {}
    components = settings.max_components or _COMPARED_COMPONENTS
    mixture = pca.principal_components(
        samples.covariance(0.5),
        centred=False,
        max_components=max(_COORDINATES, 3 * components),
        groups=samples.groups,
        memory_gb=memory_gb,
    )
    axes = (mixture.components / np.sqrt(mixture.variance)[:, None]).T
    rows = [(deviation @ axes, float(deviation @ deviation)) for deviation in samples]
    kinds = [
        SampleParts(
            coordinates=np.stack([coordinates for coordinates, _ in part]),
            squares=np.array([square for _, square in part]),
            centred=number == 0,
        )
        for number, part in enumerate(rows[k : k + samples.head_count] for k in range(0, len(rows), samples.head_count))
    ]
    rms = cross_validated_shrinkage(kinds, samples.prior @ axes, float((samples.prior**2).sum()), components)
    rms /= np.sqrt(skin_count)
    return SHRINKAGE_GRID[int(rms.argmin())], dict(zip(SHRINKAGE_GRID, rms.tolist(), strict=True))


def _symmetrized(
    template: Float[np.ndarray, "V 3"], basis: Float[np.ndarray, "K V 3"], data: GNMData
) -> tuple[Float[np.ndarray, "V 3"], Float[np.ndarray, "K V 3"]]:
    """Removes asymmetries of iterative solutions, and of a previous template whose eyes and teeth are not symmetric."""
    mirror = data.mirror_indices
    mirror_images = mirrored(basis, mirror)
    sign = np.where((basis * mirror_images).sum((1, 2)) < 0, -1, 1)[:, None, None]
    return (template + template[mirror] * FLIP) / 2, (basis + sign * mirror_images) / 2


def _with_eyeballs(
    template: Float[np.ndarray, "V 3"], basis: Float[np.ndarray, "K V 3"], data: GNMData, eyelids_follow: bool
) -> tuple[Float[np.ndarray, "V 3"], Float[np.ndarray, "K V 3"]]:
    """Places the eyeballs between the eyelids of the template (in place) and of every component."""
    for rim in eyelids.eyelid_rims(data):
        template[rim.ball] += eyelids.eyeball_placement(rim, template)
    both = eyelids.eyelid_rims(replace(data, template_vertex_positions=template))
    motions = np.stack([eyelids.eyeball_motion(rim, template, basis) for rim in both], 1)
    if eyelids_follow:
        basis = eyelids.eyelids_on_eyeballs(both, data, template, basis, motions)
    for side, rim in enumerate(both):
        basis[:, rim.ball] = motions[:, None, side]
    return template, basis
