"""Expression basis by region: uncentred principal components under soft masks [GNM, Head Expression];
docs/algorithms.md, "Expression basis"."""

import itertools
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int

from coregister.anatomy import placement
from coregister.next_model.shrinkage import ShrunkCovariance
from coregister.region_masks import FLIP, REGIONS, mirrored, regional_masks
from registration.geometry import pca
from registration.geometry.topology import vertex_areas
from registration.model import regions
from registration.model.gnm_npz import GNMData

_BLOCK = 256  # samples whose coefficients are computed together


@dataclass(frozen=True, kw_only=True)
class ExpressionSettings:
    """Settings of the regional expression bases.

    Attributes:
        variance_ratio: fraction of each region's energy that its components must explain, at least.
        max_components: by region, of `REGIONS` but the right eye's, which mirrors the left; None: as many as needed.
        shrinkage: fraction of the energy from the previous model, 0 to 1.
        both_eyes: the right eye's samples, mirrored, are samples of the left eye too.
        by_area: weight vertices by area instead of equally.
    """

    variance_ratio: float = 0.99
    max_components: Mapping[str, int] | None = None
    shrinkage: float = 0.0
    both_eyes: bool = True
    by_area: bool = False


@dataclass(frozen=True, kw_only=True, eq=False)
class RegionBasis:
    """K components of one region; metres, the model's frame."""

    basis: Float[np.ndarray, "K V 3"]
    energy: Float[np.ndarray, "K"]  # of the skin, in the lower face of the lower teeth too; m^2 summed over coordinates
    variance_ratio: float  # of the region's energy, that the components explain
    shrinkage: float  # as used
    method: str  # of the principal components
    missed: float  # fraction of the energy that as many other components could explain more, at most; 0: exact


@dataclass(frozen=True, kw_only=True, eq=False)
class CoefficientStatistics:
    """Mean and covariance of the regional components' coefficients over the samples, subjects balanced."""

    names: tuple[str, ...]
    mean: Float[np.ndarray, "E"]
    covariance: Float[np.ndarray, "E E"]  # about the mean


def regional_bases(
    displacements: Iterable[Float[np.ndarray, "V 3"]],
    weights: Float[np.ndarray, "S"],
    data: GNMData,
    settings: ExpressionSettings | None = None,
    memory_gb: float = 4.0,
) -> dict[str, RegionBasis]:
    """Return the bases of all `REGIONS`: principal components of S_r x, uncentred, with the soft mask S_r.

    The right eye's basis mirrors the left eye's. The lower face's samples contain the lower teeth ("the motion of the
    jaw together with the lower teeth", [GNM, Head Expression]), and the other parts of the jaw follow them.

    Args:
        displacements: S expressions minus their neutrals, metres, in the frame of `data`; read several times.
        weights: of the samples, which balance subjects.
        data: a model with the new template and the previous expression basis.
        settings: of the bases.
        memory_gb: available for one covariance matrix, or for what replaces it.
    """
    settings = settings or ExpressionSettings()
    masks, mirror = dict(zip(REGIONS, regional_masks(data), strict=True)), data.mirror_indices
    masks["lower_face_region"] = masks["lower_face_region"] + regions.lower_teeth(data)
    bases: dict[str, RegionBasis] = {}
    for name, mask in masks.items():
        if name == "right_eye_region":
            left = bases["left_eye_region"]
            bases[name] = replace(left, basis=mirrored(left.basis, mirror))
            continue
        rows = np.flatnonzero(mask > 0)
        vertex_scales = _vertex_scales(data, rows, settings.by_area)
        both = settings.both_eyes and name == "left_eye_region"
        samples = _MaskedSamples(
            displacements, rows, mask[rows, None] * vertex_scales, data.mirror_indices if both else None
        )
        max_components = None if settings.max_components is None else settings.max_components.get(name)
        sample_weights = np.repeat(weights, 2) if both else weights
        bases[name] = _region_basis(samples, sample_weights, vertex_scales, data, settings, max_components, memory_gb)
    lower = bases["lower_face_region"].basis
    parts = regions.jaw_parts(data)
    lower[:, parts] = jaw_motion(lower, data)[:, parts]
    return {name: bases[name] for name in REGIONS}


def jaw_motion(basis: Float[np.ndarray, "K V 3"], data: GNMData) -> Float[np.ndarray, "K V 3"]:
    """Return the motion w x p + t of the lower teeth in each component, at every vertex; metres.

    Linear in the coefficient, which a finite rotation would not be (docs/algorithms.md, "Placement of teeth and
    tongue"). [GNM, Initial Placement of Teeth and Tongue] places teeth by the skin of chin and lower lip while their
    own motion is unknown; that is inaccurate: MakeHuman's open jaw moves the lower teeth by 22 mm, and the motion of
    the chin differs by 4 mm.
    """
    return placement.rigid_motion(basis, data, regions.lower_teeth(data))


def transfer_components(data: GNMData) -> Int[np.ndarray, "_"]:
    """Return the previous model's expression components that move no skin: the tongue's and the pupils'."""
    skin = regions.skin(data)
    return np.flatnonzero(np.abs(data.expression_basis[:, skin]).max(axis=(1, 2), initial=0) == 0)


def coefficient_statistics(
    displacements: Iterable[Float[np.ndarray, "V 3"]],
    weights: Float[np.ndarray, "S"],
    bases: Mapping[str, RegionBasis],
    data: GNMData,
) -> CoefficientStatistics:
    """Return mean and covariance of the samples' coefficients.

    Coefficients are least-squares solutions over the skin for all regions at once, since bases are not orthogonal.

    Args:
        displacements: S expressions minus their neutrals, metres.
        weights: of the samples.
        bases: of `regional_bases`.
        data: a model of their topology.
    """
    skin = regions.skin(data)
    flat = np.concatenate([region.basis[:, skin].reshape(len(region.basis), -1) for region in bases.values()])
    inverse = np.linalg.pinv(flat @ flat.T, rcond=1e-12, hermitian=True)
    axes = (inverse @ flat).astype(np.float32).T
    blocks = iter(displacements)
    rows = np.concatenate(
        [
            np.stack([sample[skin].ravel() for sample in block]).astype(np.float32) @ axes
            for block in iter(lambda: list(itertools.islice(blocks, _BLOCK)), [])
        ]
    ).astype(np.float64)
    fractions = weights / weights.sum()
    mean = fractions @ rows
    deviations = (rows - mean) * np.sqrt(fractions)[:, None]
    names = tuple(f"{name}_{k:03d}" for name, region in bases.items() for k in range(len(region.basis)))
    return CoefficientStatistics(names=names, mean=mean, covariance=deviations.T @ deviations)


def _vertex_scales(data: GNMData, rows: Int[np.ndarray, "R"], by_area: bool) -> Float[np.ndarray, "R 1"]:
    """Square roots of the vertices' weights in the components."""
    if not by_area:
        return np.ones((len(rows), 1))
    area = vertex_areas(data.template_vertex_positions, data.triangles)[rows]
    return np.sqrt(np.maximum(area, 0.01 * area.mean()) / area.mean())[:, None]


class _MaskedSamples:
    """One region's rows of every sample, scaled; with `mirror` each sample is followed by its mirror image."""

    def __init__(
        self,
        displacements: Iterable[Float[np.ndarray, "V 3"]],
        rows: Int[np.ndarray, "R"],
        scale: Float[np.ndarray, "R 1"],
        mirror: Int[np.ndarray, "V"] | None,
    ):
        self._displacements, self.rows, self.scale = displacements, rows, scale
        self._mirror_rows = None if mirror is None else mirror[rows]

    def __iter__(self) -> Iterator[Float[np.ndarray, "D"]]:
        for displacement in self._displacements:
            yield (displacement[self.rows] * self.scale).ravel()
            if self._mirror_rows is not None:
                yield (displacement[self._mirror_rows] * FLIP * self.scale).ravel()


def _region_basis(
    samples: _MaskedSamples,
    weights: Float[np.ndarray, "S"],
    vertex_scales: Float[np.ndarray, "R 1"],
    data: GNMData,
    settings: ExpressionSettings,
    max_components: int | None,
    memory_gb: float,
) -> RegionBasis:
    rows, size = samples.rows, 3 * len(samples.rows)
    previous = (data.expression_basis[:, rows].astype(np.float64) * samples.scale).reshape(-1, size)
    covariance = ShrunkCovariance(samples, weights, float(weights.sum()), previous, settings.shrinkage)
    principal = pca.principal_components(
        covariance,
        centred=False,
        variance_ratio=settings.variance_ratio,
        max_components=max_components,
        memory_gb=memory_gb,
    )
    basis = np.zeros((len(principal.variance), *data.template_vertex_positions.shape))
    basis[:, rows] = principal.components.reshape(len(basis), len(rows), 3) / vertex_scales
    return RegionBasis(
        basis=basis,
        energy=principal.variance,
        variance_ratio=principal.variance_ratio,
        shrinkage=covariance.shrinkage,
        method=principal.method,
        missed=principal.missed,
    )
