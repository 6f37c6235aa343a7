"""One subject's registrations as arrays, checked: what stabilization works on."""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from registration.errors import InputError
from registration.geometry.topology import vertex_areas
from registration.model import regions
from registration.model.gnm_npz import GNMData, topology_hash
from registration.types import Registration

_LEAST_SEEN = 0.2  # of the skull's skin, for an alignment that means something


@dataclass(frozen=True, kw_only=True)
class SubjectMeshes:
    """A neutral and S expressions in the model's topology; vertices float32, metres, confidence in [0, 1]."""

    subject: str
    neutral: Float[np.ndarray, "V 3"]
    neutral_confidence: Float[np.ndarray, "V"]
    names: tuple[str, ...]  # of the expressions' registrations
    labels: tuple[str, ...]  # what was performed; several may be the same
    vertices: Float[np.ndarray, "S V 3"]  # each in its capture's world
    confidence: Float[np.ndarray, "S V"]  # 0: seen by no camera


@dataclass(frozen=True, kw_only=True)
class SkullSkin:
    """Where the skull's motion may be read off: each vertex' area on the template, m^2; 0 on what is no such skin."""

    triangles: Int[np.ndarray, "F 3"]
    area: Float[np.ndarray, "V"]

    @classmethod
    def of(cls, data: GNMData) -> "SkullSkin":
        """Raises InputError for a model without the vertex groups."""
        area = vertex_areas(data.template_vertex_positions, data.triangles)
        return cls(triangles=data.triangles, area=area * regions.skull_skin(data))


def subject_meshes(
    subject: str, neutral: Registration, expressions: Iterable[tuple[str, str, Registration]], skin: SkullSkin
) -> SubjectMeshes:
    """A subject's registrations, taken one after the other: (name, label, registration) of each expression.

    Only vertices and confidence are kept.

    Raises:
        InputError: no expression; a registration that failed, is of another topology than the model, holds numbers
            that are not finite, or in which hardly any of the skull's skin was seen.
    """
    _check(f"{subject}, neutral", neutral, skin)
    names, labels, vertices, confidence = [], [], [], []
    for name, label, registration in expressions:
        _check(f"{subject}, {name}", registration, skin)
        names.append(name)
        labels.append(label)
        vertices.append(registration.vertices.astype(np.float32))
        confidence.append(registration.confidence.astype(np.float32))
    if not names:
        raise InputError(
            "A subject has no expression to stabilize",
            where=subject,
            expected="a neutral and at least one expression",
            got="the neutral only",
            fix="register the subject's expressions, or leave it out",
        )
    return SubjectMeshes(
        subject=subject,
        neutral=neutral.vertices.astype(np.float32),
        neutral_confidence=neutral.confidence.astype(np.float32),
        names=tuple(names),
        labels=tuple(labels),
        vertices=np.stack(vertices),
        confidence=np.stack(confidence),
    )


def _check(where: str, registration: Registration, skin: SkullSkin) -> None:
    if registration.status == "failed":
        raise InputError(
            "A registration failed",
            where=where,
            expected="converged or stopped",
            got=registration.reason,
            fix="register it again, or leave it out",
        )
    if topology_hash(registration.triangles) != topology_hash(skin.triangles):
        raise InputError(
            "A registration has another topology than the model",
            where=where,
            expected=f"the model's {len(skin.area)} vertices and {len(skin.triangles)} triangles",
            got=f"{len(registration.vertices)} vertices and {len(registration.triangles)} triangles, or another order",
            fix="register all subjects with one model, and give that model",
        )
    for name in ("vertices", "confidence"):
        bad = np.count_nonzero(~np.isfinite(getattr(registration, name)))
        if bad:
            raise InputError(
                f"A registration's {name} are not finite",
                where=where,
                expected="finite numbers",
                got=f"{bad} NaN or infinite",
                fix="register it again",
            )
    seen = skin.area[registration.confidence > 0].sum() / skin.area.sum()
    if seen < _LEAST_SEEN:
        raise InputError(
            "Hardly any skin was seen",
            where=f"{where}, confidence",
            expected=f"at least {100 * _LEAST_SEEN:.0f} % of the skin on the skull seen by a camera",
            got=f"{100 * seen:.1f} %",
            fix="register with views of the face and the sides of the head",
        )
