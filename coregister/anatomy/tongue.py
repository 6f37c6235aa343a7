"""The tongue's expression basis, from poses of a rig [GNM, Tongue Modeling and Articulation]."""

import itertools
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np
from jaxtyping import Float

from coregister.anatomy.part_basis import PartBasis
from coregister.anatomy.tongue_fit import FittedTongues, KeyPointFit
from coregister.anatomy.tongue_keypoints import TongueRecording
from coregister.anatomy.tongue_mouth import JawOpening
from coregister.anatomy.tongue_poses import PoseSettings, draw_poses, model_expressions
from coregister.anatomy.tongue_rig import TongueRig
from coregister.region_masks import FLIP
from registration.anatomy.tongue_structure import find_tongue
from registration.errors import InputError, check_seed
from registration.frames import MM_PER_M
from registration.geometry import pca
from registration.model.gnm_npz import GNMData

_LEAST_SAMPLES = 40
_LEAST_GAP = 12e-3  # metres between the incisors, beyond the template's: an open mouth
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


@dataclass(frozen=True, kw_only=True, eq=False)
class TongueSources:
    """Data of real tongues.

    Attributes:
        expressions: displacements of registered expressions from their neutrals, in the model's frame, metres; of
            these, only the outer skin counts.
        recordings: key points; poses fitted to them are up to a quarter of the samples.
        fill: whether expressions of the model fill up what open mouths there are, to `PoseSettings.mouths`; otherwise
            expressions without an open mouth are refused.
    """

    expressions: Sequence[Float[np.ndarray, "V 3"]] = ()
    recordings: Sequence[TongueRecording] = ()
    fill: bool = False


def tongue_basis(
    data: GNMData,
    settings: TongueSettings | None = None,
    *,
    sources: TongueSources | None = None,
) -> PartBasis:
    """Build the expression components of the tongue; the template stays, so that zero is the tongue at rest.

    The mean of the samples is the first component, since it is a tongue that leaves the closed mouth: a coefficient of
    1 gives it, and the others, principal components about the mean, are scaled by standard deviations.

    Args:
        data: a model with the official components and groups.
        settings: of the samples; None: the defaults.
        sources: registrations and recordings; None: expressions of the model itself.

    Raises:
        InputError: too few samples, registrations with an open mouth or poses that fit, or the model's tongue has no
            tip.
    """
    settings, sources = settings or TongueSettings(), sources or TongueSources()
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
    mouths = _open_mouths(sources, data, settings.poses.mouths) if sources.expressions else []
    registered = len(mouths)
    fits = _fitted(sources, rig, data, settings)
    count = (settings.samples + 1) // 2 - sum(len(fit.times) for fit in fits)
    if sources.fill or not mouths:
        mouths += itertools.islice(model_expressions(data, settings.poses, rng), settings.poses.mouths - registered)
    poses = draw_poses(rig, data, mouths, count, settings.poses, rng)
    halves = np.concatenate([poses.displacements, *(fit.displacements for fit in fits)])
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
        "mouths": len(mouths),
        "mouths_registered": registered,
        "mouths_too_tight": poses.tight,
        "rejected": sum(poses.rejected.values()),
        "rejected_for": poses.rejected,
        "recordings": [
            {
                "times": len(fit.times),
                "residual_mm": float(np.sqrt(np.mean(fit.residual_mm**2))),
                "limited": int(fit.limited.sum()),
            }
            for fit in fits
        ],
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


def _open_mouths(sources: TongueSources, data: GNMData, most: int) -> list[Float[np.ndarray, "V 3"]]:
    """Expressions with an open mouth, of which only the outer skin counts; at most so many to fill up."""
    jaw = JawOpening.of(data)
    expressions = [jaw.of_skin(np.asarray(moved, np.float64), data) for moved in sources.expressions]
    gaps = [jaw.gap(moved, data) for moved in expressions]
    opened = [moved for moved, gap in zip(expressions, gaps, strict=True) if gap >= _LEAST_GAP]
    if sources.fill and len(opened) > most:
        return [opened[k] for k in np.linspace(0, len(opened) - 1, most).round().astype(int)]
    if not opened and not sources.fill:
        raise InputError(
            "No registration has an open mouth",
            where="registrations",
            expected=f"incisors at least {_LEAST_GAP * MM_PER_M:.0f} mm farther apart than in the neutral",
            got=f"{len(gaps)} expressions, at most {max(gaps) * MM_PER_M:.1f} mm",
            fix="give registrations of people who open their mouths, or none",
        )
    return opened


def _fitted(sources: TongueSources, rig: TongueRig, data: GNMData, settings: TongueSettings) -> list[FittedTongues]:
    """Poses of all recordings, each with its mirror image up to a quarter of the samples together."""
    fit = KeyPointFit(data=data, rig=rig)
    most = max(settings.samples // 8 // max(len(sources.recordings), 1), 1)
    return [fit.fit(recording, most) for recording in sources.recordings]
