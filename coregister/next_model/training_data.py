"""Training data of a model: meshes of subjects, validated before anything is computed."""

from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int

from registration.errors import InputError
from registration.frames import transform_points
from registration.geometry.rigid import align
from registration.model.gnm import GNM
from registration.model.gnm_npz import GNMData, topology_hash
from registration.stabilize.subject_meshes import SkullSkin
from registration.storage.hashing import hash_arrays
from registration.types import Parameters, Registration

NEUTRAL = "neutral"  # the label of neutrals
_MIN_NEUTRALS = 2
_ALONE = 0.999  # of the largest skinning weight: a vertex that moves with one joint alone


@dataclass(frozen=True, kw_only=True, eq=False)
class TrainingMesh:
    """One registration: vertices in the model's order, metres, any frame."""

    name: str
    label: str  # of the expression
    vertices: Float[np.ndarray, "V 3"]
    confidence: Float[np.ndarray, "V"]  # 0 to 1; 0: observed by no camera
    triangles: Int[np.ndarray, "F 3"]
    digest: str = ""  # of the source; empty: of the arrays
    figures: Mapping[str, float] = field(default_factory=dict)  # of `expression_outliers.REPORTED_FIGURES`


@dataclass(frozen=True, kw_only=True, eq=False)
class TrainingSubject:
    """A neutral and stabilized expressions: in the neutral's frame, the skull where the neutral has it."""

    name: str
    neutral: TrainingMesh | None  # None: validation raises an error with the subject's name
    expressions: tuple[TrainingMesh, ...] = ()
    tags: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True, kw_only=True, eq=False)
class TrainingSet:
    """Neutrals of N validated subjects, and the digests of all their meshes."""

    subjects: tuple[str, ...]
    neutrals: Float[np.ndarray, "N V 3"]  # float32
    confidence: Float[np.ndarray, "N V"]  # float32, of the neutrals
    expression_count: int  # of all subjects
    digests: Mapping[str, str]  # "subject, mesh" -> digest
    tags: tuple[Mapping[str, Any], ...]


def unpose(registration: Registration, model: GNM) -> Float[np.ndarray, "V 3"]:
    """Return a registration's bind pose with offsets: without joint rotations and translation, at its own scale.

    Metres, the model's frame. A neutral with a rotated neck would add that rotation to the identity basis.

    Args:
        registration: of any expression.
        model: with which it was registered.
    """
    with torch.no_grad():
        names = ("identity", "expression", "scale")
        variables = {name: torch.as_tensor(getattr(registration, name)) for name in names}
        pose = model.neutral()
        parameters = Parameters(**variables, rotations=pose.rotations, translation=pose.translation)
        vertices = model(parameters, torch.as_tensor(registration.offsets))
    return np.asarray(vertices.numpy(), np.float32)


def skull_weights(data: GNMData) -> Float[np.ndarray, "V"]:
    """Return areas, m^2, of the skin over the skull that moves with the skull's joint alone; 0 elsewhere.

    Posed and unposed it differs by one rigid motion.
    """
    area = SkullSkin.from_model(data).area
    weight = data.skinning_weights[(data.skinning_weights @ area).argmax()]
    return np.asarray(area * (weight > _ALONE * weight.max()))


def unposed_expression(
    registration: Registration,
    stabilized: Float[np.ndarray, "V 3"],
    T_neutral_expression: Float[np.ndarray, "4 4"],
    neutral: Registration,
    model: GNM,
    weights: Float[np.ndarray, "V"],
) -> Float[np.ndarray, "V 3"]:
    """Return an expression with its joints at rest and its skull where the unposed neutral (`unpose`) has it.

    A head that turned on its neck between neutral and expression would add the neck's deformation to the expressions.
    With the rigid motion G of the skull from the unposed expression to the unposed neutral, which stabilization
    determines, it is G u + d: u is the unposed expression, d what stabilization removed from single regions.

    Args:
        registration: of the expression.
        stabilized: its vertices in the frame of the registered neutral, metres.
        T_neutral_expression: the skull's motion: p_neutral = T_neutral_expression @ p_expression.
        neutral: registration of the subject's neutral.
        model: with which both were registered.
        weights: of the vertices, `skull_weights`.
    """
    unposed, unposed_neutral = (unpose(each, model).astype(np.float64) for each in (registration, neutral))
    posed, posed_neutral = (each.vertices.astype(np.float64) for each in (registration, neutral))
    T_posed_unposed = align(unposed[None], posed, weights[None])[0]
    T_unposed_posed = align(posed_neutral[None], unposed_neutral, weights[None])[0]
    aligned = transform_points(T_unposed_posed @ T_neutral_expression @ T_posed_unposed, unposed)
    removed = stabilized.astype(np.float64) - transform_points(T_neutral_expression, posed)
    return np.asarray(aligned + removed @ T_unposed_posed[:3, :3].T, np.float32)


def validate_training_set(
    subjects: Iterable[TrainingSubject], data: GNMData, *, labels: Collection[str] | None = None
) -> TrainingSet:
    """Read every mesh once, check it, and keep the neutrals.

    Args:
        subjects: read once.
        data: the model of the meshes' topology.
        labels: permitted labels of expressions; None: any.

    Raises:
        InputError: a subject without a neutral, or twice; a mesh of another topology, with non-finite numbers or
            with confidence out of range; an unknown label; fewer than two neutrals.
    """
    topology = topology_hash(data.triangles)
    neutrals: dict[str, TrainingMesh] = {}
    digests, tags, expression_count = dict[str, str](), [], 0
    for subject in subjects:
        neutral = subject.neutral
        if neutral is None:
            raise InputError(
                "A subject has no neutral",
                where=subject.name,
                expected="a registration of the neutral face: expressions are displacements from it",
                got=f"{len(subject.expressions)} expressions only",
                fix="register the subject's neutral, or exclude the subject",
            )
        if subject.name in neutrals:
            raise InputError(
                "A subject's name occurs twice",
                where=subject.name,
                expected="one name a subject",
                got="two subjects",
                fix="give each its own name",
            )
        for mesh in (neutral, *subject.expressions):
            where = f"{subject.name}, {mesh.name}"
            _check_mesh(where, mesh, topology, data)
            if mesh is not neutral and labels is not None and mesh.label not in labels:
                raise InputError(
                    "A label is unknown",
                    where=where,
                    expected=", ".join(sorted(labels)),
                    got=mesh.label,
                    fix="correct the label, or add it",
                )
            digests[where] = mesh.digest or hash_arrays(mesh.vertices, mesh.confidence)
        neutrals[subject.name] = neutral
        expression_count += len(subject.expressions)
        tags.append(subject.tags)
    if len(neutrals) < _MIN_NEUTRALS:
        raise InputError(
            "There are too few neutrals",
            where="subjects",
            expected=f"at least {_MIN_NEUTRALS}",
            got=len(neutrals),
            fix="register more subjects",
        )
    return TrainingSet(
        subjects=tuple(neutrals),
        neutrals=np.stack([mesh.vertices.astype(np.float32) for mesh in neutrals.values()]),
        confidence=np.stack([mesh.confidence.astype(np.float32) for mesh in neutrals.values()]),
        expression_count=expression_count,
        digests=digests,
        tags=tuple(tags),
    )


def check_rank(neutrals: int, components: int | None, *, previous: int, mirrored: bool) -> None:
    """Check that an identity basis can have as many components as requested.

    Args:
        neutrals: number of heads.
        components: requested; None: any number.
        previous: components of the previous model that take part.
        mirrored: mirror images of the heads take part too.

    Raises:
        InputError: the samples span fewer dimensions.
    """
    rank = (2 * neutrals if mirrored else neutrals) - 1 + previous
    if components is None or 0 < components <= rank:
        return
    images = " and their mirror images" if mirrored else ""
    raise InputError(
        "There are too few samples for the requested rank",
        where="components of the identity basis",
        expected=f"1 to {rank}: {neutrals} neutrals{images} about their mean, {previous} of the previous model",
        got=components,
        fix="register more subjects, or request fewer components",
    )


def _check_mesh(where: str, mesh: TrainingMesh, topology: str, data: GNMData) -> None:
    count = len(data.template_vertex_positions)
    if topology_hash(mesh.triangles) != topology or mesh.vertices.shape != (count, 3):
        raise InputError(
            "A mesh has another topology than the model",
            where=where,
            expected=f"the model's {count} vertices and {len(data.triangles)} triangles",
            got=f"{len(mesh.vertices)} vertices and {len(mesh.triangles)} triangles, or another order",
            fix="register all subjects with one model, and use that model",
        )
    for name in ("vertices", "confidence"):
        if invalid := np.count_nonzero(~np.isfinite(getattr(mesh, name))):
            raise InputError(
                f"A mesh's {name} are not finite",
                where=where,
                expected="finite numbers",
                got=f"{invalid} NaN or infinite",
                fix="register it again, or exclude it",
            )
    if mesh.confidence.shape != (count,) or mesh.confidence.min() < 0 or mesh.confidence.max() > 1:
        raise InputError(
            "A mesh's confidence is out of range",
            where=where,
            expected=f"{count} numbers in [0, 1]",
            got=f"{mesh.confidence.shape}, {mesh.confidence.min()} to {mesh.confidence.max()}",
            fix="register it again",
        )
