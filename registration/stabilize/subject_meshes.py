"""The registrations of one subject as checked arrays: the input of stabilization."""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from registration.errors import InputError
from registration.frames import compact
from registration.geometry.topology import vertex_areas
from registration.model import regions
from registration.model.gnm_npz import GNMData, topology_hash
from registration.types import Registration

_MIN_OBSERVED = 0.2  # fraction of the skin on the skull that an alignment needs


@dataclass(frozen=True, kw_only=True)
class SubjectMeshes:
    """A neutral and S expressions in the model's topology, metres; confidence in [0, 1].

    Vertices are float32, or float64 where the world's origin is far.
    """

    subject: str
    neutral: Float[np.ndarray, "V 3"]  # in its capture's world
    neutral_confidence: Float[np.ndarray, "V"]
    names: tuple[str, ...]  # of the expressions' registrations
    labels: tuple[str, ...]  # the performed expressions; several may be equal
    vertices: Float[np.ndarray, "S V 3"]  # each in its capture's world
    confidence: Float[np.ndarray, "S V"]  # 0: no camera observed the vertex


@dataclass(frozen=True, kw_only=True)
class SkullSkin:
    """The skin that follows the skull: vertex areas on the template, m^2; 0 elsewhere."""

    triangles: Int[np.ndarray, "F 3"]
    area: Float[np.ndarray, "V"]

    @classmethod
    def from_model(cls, data: GNMData) -> "SkullSkin":
        """Compute the areas of a model.

        Args:
            data: a model in this project's format.

        Returns:
            The areas of `regions.skull_skin`.

        Raises:
            InputError: the model lacks a vertex group of that region.
        """
        area = vertex_areas(data.template_vertex_positions, data.triangles)
        return cls(triangles=data.triangles, area=area * regions.skull_skin(data))


def subject_meshes(
    subject: str, neutral: Registration, expressions: Iterable[tuple[str, str, Registration]], skin: SkullSkin
) -> SubjectMeshes:
    """Collect the vertices and the confidence of a subject's registrations.

    Args:
        subject: its name.
        neutral: registration of the neutral.
        expressions: (name, label, registration) of each expression. Read one after the other: only vertices and
            confidence stay in memory.
        skin: of the model that the captures were registered with.

    Returns:
        The arrays, in the order of `expressions`.

    Raises:
        InputError: there is no expression; a registration failed, has another topology than the model, is not finite,
            or less than a fifth of the skin on the skull was observed in it.
    """
    _check(f"{subject}, neutral", neutral, skin)
    names, labels, vertices, confidence = [], [], [], []
    for name, label, registration in expressions:
        _check(f"{subject}, {name}", registration, skin)
        names.append(name)
        labels.append(label)
        vertices.append(compact(registration.vertices))
        confidence.append(registration.confidence.astype(np.float32))
    if not names:
        raise InputError(
            "A subject has no expression to stabilize",
            where=subject,
            expected="a neutral and at least one expression",
            got="the neutral only",
            fix="register the subject's expressions, or exclude the subject",
        )
    return SubjectMeshes(
        subject=subject,
        neutral=compact(neutral.vertices),
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
            fix="register it again, or exclude it",
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
        invalid = np.count_nonzero(~np.isfinite(getattr(registration, name)))
        if invalid:
            raise InputError(
                f"A registration's {name} are not finite",
                where=where,
                expected="finite numbers",
                got=f"{invalid} NaN or infinite",
                fix="register it again",
            )
    observed = skin.area[registration.confidence > 0].sum() / skin.area.sum()
    if observed < _MIN_OBSERVED:
        raise InputError(
            "Hardly any skin was observed",
            where=f"{where}, confidence",
            expected=f"at least {100 * _MIN_OBSERVED:.0f} % of the skin on the skull observed by a camera",
            got=f"{100 * observed:.1f} %",
            fix="register with views of the face and the sides of the head",
        )
