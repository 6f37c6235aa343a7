"""Expression basis by region: uncentred principal components under soft masks [GNM, Head Expression]."""

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from coregister.next_model.shrinkage import Mixed
from coregister.region_masks import FLIP, REGIONS, mirrored, regional_masks
from registration.geometry import pca
from registration.geometry.rigid import fit_twists, motion_fields
from registration.geometry.topology import vertex_areas
from registration.model import regions
from registration.model.gnm_npz import GNMData


@dataclass(frozen=True, kw_only=True)
class Expressions:
    """What the regional bases are made of."""

    share: float = 0.99  # of each region's energy, kept
    most: Mapping[str, int] | None = None  # components by region, of `REGIONS` but the right eye's
    previous: float = 0.0  # of the energy, from the previous model
    both_eyes: bool = True  # the right eye's samples, mirrored, are the left eye's too
    by_area: bool = False  # vertices count by their area instead of alike


@dataclass(frozen=True, kw_only=True, eq=False)
class Region:
    """K components of one region; metres, the model's frame."""

    basis: Float[np.ndarray, "K V 3"]
    energy: Float[np.ndarray, "K"]  # of skin, in the lower face of lower teeth too, m^2 summed over coordinates
    share: float  # of the region's energy, kept
    previous: float  # share of it that is the previous model's
    method: str  # of the principal components


@dataclass(frozen=True, kw_only=True, eq=False)
class Coefficients:
    """How coefficients of the regional components are spread over the samples, subjects balanced."""

    names: tuple[str, ...]
    mean: Float[np.ndarray, "E"]
    covariance: Float[np.ndarray, "E E"]  # about the mean


def regional_bases(
    displacements: Iterable[Float[np.ndarray, "V 3"]],
    weights: Float[np.ndarray, "S"],
    data: GNMData,
    settings: Expressions | None = None,
    memory_gb: float = 4.0,
) -> dict[str, Region]:
    """By name of `REGIONS`: X_r = X * S_r, uncentred; the right eye mirrors the left; the jaw takes the tongue along.

    `displacements` of expressions from their neutrals, in the frame of the model `data`, whose template is the new one
    and whose expression basis the previous; read several times. Their skin counts, and in the lower face their lower
    teeth ("the motion of the jaw together with the lower teeth", [GNM, Head Expression]). `weights` balance subjects.
    """
    settings = settings or Expressions()
    masks, mirror = dict(zip(REGIONS, regional_masks(data), strict=True)), data.mirror_indices
    masks["lower_face_region"] = masks["lower_face_region"] + regions.lower_teeth(data)
    found: dict[str, Region] = {}
    for name, mask in masks.items():
        if name == "right_eye_region":
            left = found["left_eye_region"]
            found[name] = Region(**{**vars(left), "basis": mirrored(left.basis, mirror)})
        else:
            both = settings.both_eyes and name == "left_eye_region"
            found[name] = _region(displacements, weights, data, mask, name, both, settings, memory_gb)
    lower = found["lower_face_region"].basis
    parts = regions.jaw_parts(data)
    lower[:, parts] = with_jaw(lower, data)[:, parts]
    return {name: found[name] for name in REGIONS}


def with_jaw(basis: Float[np.ndarray, "K V 3"], data: GNMData) -> Float[np.ndarray, "K V 3"]:
    """The motion w x p + t of the lower teeth in each component, everywhere: linear in the coefficient, as a full turn
    would not be (docs/algorithms.md, "Placement of teeth and tongue").

    [GNM, Initial Placement of Teeth and Tongue] places teeth by the skin of chin and lower lip while their own motion
    is unknown. That measures it badly: when MakeHuman's open jaw moves the lower teeth by 22 mm, the chin misses 4 mm.
    """
    points = data.template_vertex_positions.astype(np.float64)
    area = vertex_areas(points, data.triangles) * regions.lower_teeth(data)
    points = points - area @ points / area.sum()
    return np.tensordot(fit_twists(basis, points, area), motion_fields(points), 1)


def carried(data: GNMData) -> Int[np.ndarray, "_"]:
    """Expression components of the previous model in which no skin moves: of the tongue and the pupils."""
    skin = regions.skin(data)
    return np.flatnonzero(np.abs(data.expression_basis[:, skin]).max(axis=(1, 2), initial=0) == 0)


def coefficients(
    displacements: Iterable[Float[np.ndarray, "V 3"]],
    weights: Float[np.ndarray, "S"],
    bases: Mapping[str, Region],
    data: GNMData,
) -> Coefficients:
    """Of each sample by least squares over the skin, all regions at once: their bases are not orthogonal."""
    skin = regions.skin(data)
    flat = np.concatenate([region.basis[:, skin].reshape(len(region.basis), -1) for region in bases.values()])
    inverse = np.linalg.pinv(flat @ flat.T, rcond=1e-12, hermitian=True)
    rows = np.stack([inverse @ (flat @ sample[skin].ravel()) for sample in displacements])
    share = weights / weights.sum()
    mean = share @ rows
    away = (rows - mean) * np.sqrt(share)[:, None]
    names = tuple(f"{name}_{k:03d}" for name, region in bases.items() for k in range(len(region.basis)))
    return Coefficients(names=names, mean=mean, covariance=away.T @ away)


def _region(
    displacements: Iterable[Float[np.ndarray, "V 3"]],
    weights: Float[np.ndarray, "S"],
    data: GNMData,
    mask: Float[np.ndarray, "V"],
    name: str,
    both: bool,
    settings: Expressions,
    memory_gb: float,
) -> Region:
    rows = np.flatnonzero(mask > 0)
    root = np.ones(len(rows))
    if settings.by_area:
        area = vertex_areas(data.template_vertex_positions, data.triangles)[rows]
        root = np.sqrt(np.maximum(area, 0.01 * area.mean()) / area.mean())
    scale = (mask[rows] * root)[:, None]
    samples = _Masked(displacements, rows, scale, data.mirror_indices if both else None)
    own = np.repeat(weights, 2) if both else weights
    previous = (data.expression_basis[:, rows].astype(np.float64) * scale).reshape(-1, scale.size * 3)
    stream = Mixed(samples, own, float(own.sum()), previous, settings.previous)
    most = None if settings.most is None else settings.most.get(name)
    found = pca.principal_components(stream, centred=False, share=settings.share, most=most, memory_gb=memory_gb)
    basis = np.zeros((len(found.variance), *data.template_vertex_positions.shape))
    basis[:, rows] = found.components.reshape(len(basis), len(rows), 3) / root[:, None]
    return Region(basis=basis, energy=found.variance, share=found.share, previous=stream.share, method=found.method)


class _Masked:
    """One region's part of every sample, and with `mirror` of its mirror image after it."""

    def __init__(
        self,
        displacements: Iterable[Float[np.ndarray, "V 3"]],
        rows: Int[np.ndarray, "R"],
        scale: Float[np.ndarray, "R 1"],
        mirror: Int[np.ndarray, "V"] | None,
    ):
        self._displacements, self._rows, self._scale = displacements, rows, scale
        self._twins = None if mirror is None else mirror[rows]

    def __iter__(self) -> Iterator[Float[np.ndarray, "D"]]:
        for displacement in self._displacements:
            yield (displacement[self._rows] * self._scale).ravel()
            if self._twins is not None:
                yield (displacement[self._twins] * FLIP * self._scale).ravel()
