"""The tongue's expression basis, from poses of a rig [GNM, Tongue Modeling and Articulation]."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np
from jaxtyping import Float

from coregister.anatomy.part_basis import PartBasis
from coregister.anatomy.tongue_poses import PoseSettings, draw_poses, model_expressions
from coregister.anatomy.tongue_rig import TongueRig
from coregister.region_masks import FLIP
from registration.anatomy.tongue_structure import find_tongue
from registration.errors import InputError, check_seed
from registration.frames import MM_PER_M
from registration.geometry import pca
from registration.model.gnm_npz import GNMData

_LEAST_SAMPLES = 40
_STATED = 0.99  # the number of components for this fraction of the variance is told too


@dataclass(frozen=True, kw_only=True)
class TongueSettings:
    """Settings of the tongue's basis.

    Attributes:
        samples: poses, every second the mirror image of the one before, so that the basis is symmetric.
        seed: of the draws.
        variance_ratio: fraction of the variance that the components keep. Google's released model keeps more than the
            99 % that the paper states: 9 of its 31 components have 99 % of their variance.
        poses: what is drawn, and what is kept.
    """

    samples: int = 2500
    seed: int = 0
    variance_ratio: float = 0.9995
    poses: PoseSettings = field(default_factory=PoseSettings)


def tongue_basis(
    data: GNMData,
    settings: TongueSettings | None = None,
    *,
    expressions: Sequence[Float[np.ndarray, "V 3"]] = (),
    articulation: Sequence[Float[np.ndarray, "T 3"]] = (),
) -> PartBasis:
    """Build the expression components of the tongue; the template stays, so that zero is the tongue at rest.

    The mean of the samples is the first component, since it is a tongue that leaves the closed mouth: a coefficient of
    1 gives it, and the others, principal components about the mean, are scaled by standard deviations.

    Args:
        data: a model with the official components and groups.
        settings: of the samples; None: the defaults.
        expressions: displacements of all vertices in expressive registrations, the tongue carried by the jaw, metres;
            none: expressions of the model itself.
        articulation: further samples, displacements of the tongue fitted to key points, metres; each is used with its
            mirror image, and they take the place of as many poses drawn.

    Raises:
        InputError: too few samples, or the model's tongue has no tip.
    """
    settings = settings or TongueSettings()
    check_seed(settings.seed)
    if settings.samples < _LEAST_SAMPLES:
        raise InputError(
            "There are too few samples of the tongue",
            where="samples",
            expected=f"at least {_LEAST_SAMPLES}",
            got=settings.samples,
            fix="ask for more",
        )
    rig = TongueRig(structure=find_tongue(data))
    rng = np.random.default_rng(settings.seed)
    fitted = list(articulation)[: settings.samples // 4]  # at least three quarters of the samples are drawn
    count = (settings.samples + 1) // 2 - len(fitted)
    mouths = list(expressions) or list(model_expressions(data, settings.poses, rng))
    poses = draw_poses(rig, data, mouths, count, settings.poses, rng)
    halves = np.concatenate([poses.displacements, *(sample[None] for sample in fitted)])
    samples = np.stack([halves, halves[:, rig.structure.mirror] * FLIP], 1).reshape(-1, *halves.shape[1:])
    samples = samples[: settings.samples]
    principal = pca.principal_components(
        samples.reshape(len(samples), -1), centred=True, variance_ratio=settings.variance_ratio
    )
    components = np.concatenate([principal.mean[None], principal.components]).reshape(-1, *samples.shape[1:])
    cumulative = np.cumsum(principal.variance) / principal.total
    record: dict[str, Any] = {
        "seed": settings.seed,
        "samples": len(samples),
        "of_key_points": 2 * len(fitted),
        "mouths": len(mouths),
        "mouths_of": "registrations" if len(expressions) else "the model's expressions",
        "rejected": poses.rejected,
        "components_beside_the_mean": len(principal.variance),
        "variance_kept": principal.variance_ratio,
        f"components_for_{_STATED}": int(np.searchsorted(cumulative, _STATED)) + 1,
        "rms_mm": float(np.sqrt(principal.total / samples.shape[1]) * MM_PER_M),
        "mean_rms_mm": float(np.sqrt((principal.mean**2).sum() / samples.shape[1]) * MM_PER_M),
        "poses": asdict(settings.poses),
    }
    return PartBasis(
        part="tongue",
        vertices=rig.structure.vertices,
        components=components,
        names=("tongue_mean", *(f"tongue_{k:03d}" for k in range(len(principal.variance)))),
        record=record,
    )
