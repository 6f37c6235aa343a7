"""The teeth's components from random dentitions of a rig on the model's own teeth [GNM, Teeth modeling]."""

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float, Int

from coregister.anatomy.dental_rig import RiggedArch
from coregister.anatomy.dental_samples import Dentition, Spreads, draw_poses
from coregister.anatomy.part_basis import PartBasis
from coregister.anatomy.tooth_overlap import ToothOverlap
from registration.anatomy.tooth_structure import find_teeth
from registration.errors import InputError, check_seed
from registration.frames import MM_PER_M
from registration.geometry.pca import principal_components
from registration.model.gnm_npz import GNMData

_BATCH = 250  # samples made together
_MOST_COMPONENTS = 250
_LEAST_ACCEPTED = 0.2  # of the samples: below it the spreads do not suit the template


@dataclass(frozen=True, kw_only=True)
class TeethSettings:
    """How the dentitions are made."""

    samples: int = 5000  # kept ones
    seed: int = 0
    spreads: Spreads = field(default_factory=Spreads)
    max_overlap_mm: float = 0.2  # of two teeth: samples with more are rejected
    variance_ratio: float = 0.99  # that the components explain

    def __post_init__(self) -> None:
        check_seed(self.seed)


def teeth_basis(data: GNMData, settings: TeethSettings = TeethSettings()) -> PartBasis:  # noqa: B008  frozen
    """Make dentitions on the model's own teeth, and return their mean and their principal components.

    Args:
        data: any model of the official schema.
        settings: number of samples, spreads, seed.

    Returns:
        Components of the identity, `teeth_000` and so on, for all vertices of teeth and gums; the template is the
        samples' mean. The record says how many samples were rejected, and the share of the variance that is kept.

    Raises:
        InputError: the teeth are not found (`find_teeth`), fewer than two samples, or most samples have teeth that run
            into each other.
    """
    if settings.samples < 2:
        raise InputError(
            "Too few dentitions for components",
            where="samples",
            expected="at least 2",
            got=settings.samples,
            fix="make more, 5000 by default",
        )
    template = data.template_vertex_positions.astype(np.float64)
    arches = find_teeth(data)
    overlap = ToothOverlap([tooth for arch in arches for tooth in arch.teeth], template)
    rigs = [RiggedArch(arch=arch, template=template) for arch in arches]
    lowered = max(0.0, settings.spreads.clearance_mm / MM_PER_M - overlap.clearance())
    dentition = Dentition(upper=rigs[0], lower=rigs[1], lowered=lowered)
    vertices = np.sort(np.concatenate([arch.vertices for arch in arches]))
    samples, rejected = _samples(dentition, overlap, vertices, settings)
    found = principal_components(
        samples,
        centred=True,
        variance_ratio=settings.variance_ratio,
        max_components=min(_MOST_COMPONENTS, settings.samples - 1),
        method="randomized",
        seed=settings.seed,
    )
    count = len(found.components)
    return PartBasis(
        part="teeth",
        vertices=vertices,
        components=found.components.reshape(count, -1, 3),
        names=tuple(f"teeth_{k:03d}" for k in range(count)),
        template=template[vertices] + found.mean.reshape(-1, 3),
        record={
            "seed": settings.seed,
            "teeth": [len(arch.teeth) for arch in arches],
            "samples": settings.samples,
            "rejected": rejected,
            "components": count,
            "variance_kept": round(found.variance_ratio, 5),
            "lower_teeth_lowered_mm": round(lowered * MM_PER_M, 3),
        },
    )


def _samples(
    dentition: Dentition, overlap: ToothOverlap, vertices: Int[np.ndarray, "N"], settings: TeethSettings
) -> tuple[Float[np.ndarray, "S D"], int]:
    """Displacements of the samples that are kept, and the number of the rejected ones."""
    template = dentition.upper.template
    rows = [
        np.searchsorted(vertices, part)
        for rig in dentition.arches
        for part in (*(tooth.vertices for tooth in rig.arch.teeth), rig.arch.gum)
    ]
    kept = np.empty((settings.samples, len(vertices), 3), np.float32)
    count = rejected = batch = 0
    while count < settings.samples:
        rng = np.random.default_rng([settings.seed, batch])
        batch += 1
        poses = draw_poses(dentition, settings.spreads, _BATCH, rng)
        shapes = [rig.vertices(pose) for rig, pose in zip(dentition.arches, poses, strict=True)]
        depth = overlap.depth([points for teeth, _ in shapes for points in teeth])
        good = np.flatnonzero(depth.max(1) <= settings.max_overlap_mm / MM_PER_M)[: settings.samples - count]
        # Only samples before the last one that was needed count as tried.
        tried = _BATCH if count + len(good) < settings.samples else int(good[-1]) + 1
        rejected += tried - len(good)
        parts = [part for teeth, gum in shapes for part in (*teeth, gum)]
        for where, part in zip(rows, parts, strict=True):
            kept[count : count + len(good), where] = part[good] - template[vertices[where]]
        count += len(good)
        if count < _LEAST_ACCEPTED * batch * _BATCH and batch >= 4:
            raise InputError(
                "Teeth of most dentitions run into each other",
                where="the spreads of the dentitions on the model's teeth",
                expected=f"overlaps of at most {settings.max_overlap_mm} mm in {_LEAST_ACCEPTED:.0%} of the samples",
                got=f"{count} of {batch * _BATCH}",
                fix="use smaller spreads, or a template whose teeth do not overlap",
            )
    return kept.reshape(settings.samples, -1), rejected
