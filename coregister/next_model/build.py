"""Many registrations and the previous model -> the next model, with how it came about [GNM, GNM].

    built = build(subjects, previous)
    provenance.write(built.data, built.manifest, built.coefficients, path, previous_path)

Reads straight down: neutrals are checked, completed and aligned; the head's identity, its joints and the regional
expressions are built from them; what no skin moves with, eyes' and teeth's own shapes, the tongue's motions and the
pupils, is the previous model's; as are mesh, skinning, groups and the regions.
"""

from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from jaxtyping import Float

from coregister import joints
from coregister.next_model import expression, identity
from coregister.next_model.alignment import Aligned, Alignment, Looks, Rejected, align_neutrals, spoiled
from coregister.next_model.completion import Completion, Unseen
from coregister.next_model.displacement_store import Spool
from coregister.next_model.expression import Coefficients, Expressions, Region
from coregister.next_model.identity import HeadIdentity, Identity
from coregister.next_model.provenance import Origin, manifest
from coregister.next_model.training_data import Subject, Survey, survey
from registration.frames import transform_points
from registration.geometry.rigid import align
from registration.model.gnm_npz import GNMData
from registration.stabilize.subject_meshes import SkullSkin


@dataclass(frozen=True, kw_only=True)
class Build:
    """The resolved configuration of a build."""

    alignment: Alignment = field(default_factory=Alignment)
    unseen: Unseen = field(default_factory=Unseen)
    identity: Identity = field(default_factory=Identity)
    expressions: Expressions = field(default_factory=Expressions)
    categories: Mapping[str, str] | None = None  # every label there may be -> its category; None: any label
    memory_gb: float = 4.0  # for one covariance or what stands for it


@dataclass(frozen=True, kw_only=True, eq=False)
class Built:
    """A model and how it came about."""

    data: GNMData
    manifest: dict[str, Any]  # JSON values
    coefficients: Coefficients | None  # of the expressions; None without any: then the expression basis is the old one


def build(subjects: Iterable[Subject], previous: GNMData, settings: Build | None = None) -> Built:
    """The next model. Deterministic.

    `subjects` is read twice, one subject at a time: neutrals stay in memory, expressions on disk (`Spool`).

    Raises:
        InputError: as `survey`; fewer than two neutrals are left; a previous model without the official vertex groups.
    """
    settings = settings or Build()
    of_head = len(previous.vertex_identity_basis) - len(identity.carried(previous))
    found = survey(
        subjects,
        previous,
        labels=None if settings.categories is None else {*settings.categories},
        rank=settings.identity.most,
        previous=of_head if settings.identity.previous != 0 else 0,
        mirrored=settings.identity.mirrored,
    )
    aligned, filled = _aligned(found, previous, settings)
    head = identity.head_identity(aligned.vertices, previous, settings.identity, settings.memory_gb)
    data = _with_identity(previous, head)
    with Spool(len(head.template)) as spool:
        samples = _spooled(subjects, found, aligned, previous, spool, settings)
        bases, coefficients = dict[str, Region](), None
        if samples.weights.any():
            bases = expression.regional_bases(spool, samples.weights, data, settings.expressions, settings.memory_gb)
            coefficients = expression.coefficients(spool, samples.weights, bases, data)
            data = _with_expressions(data, bases, coefficients)
    origin = Origin(
        found=found,
        aligned=aligned,
        head=head,
        bases=bases,
        expression_subjects=samples.subjects,
        expression_labels=samples.labels,
        expression_weights=samples.weights,
        rejected=(*aligned.rejected, *samples.rejected),
        filled={"neutrals": filled, "expressions": samples.filled},
    )
    told = manifest(origin, previous, data, settings, settings.categories)
    return Built(data=data, manifest=told, coefficients=coefficients)


@dataclass(frozen=True, kw_only=True)
class _Samples:
    """The expressions in the spool, in order."""

    subjects: tuple[str, ...]
    labels: tuple[str, ...]
    weights: Float[np.ndarray, "S"]  # one over the subject's count; 0 for those left out
    rejected: tuple[Rejected, ...]
    filled: int  # samples of which some skin was not seen


def _aligned(found: Survey, previous: GNMData, settings: Build) -> tuple[Aligned, int]:
    """Neutrals with unseen skin filled, aligned; and how many there was something to fill of."""
    stable, template = SkullSkin.of(previous).area, previous.template_vertex_positions.astype(np.float64)
    T_model_head = align(found.neutrals, template, found.confidence * stable)
    complete = Completion(previous, previous.vertex_identity_basis, settings.unseen)
    heads, filled = np.empty_like(found.neutrals), 0
    for number, (T, vertices, sure) in enumerate(zip(T_model_head, found.neutrals, found.confidence, strict=True)):
        away = transform_points(T, vertices.astype(np.float64)) - template
        heads[number] = template + complete(away, sure)
        filled += complete.unseen(sure)
    aligned = align_neutrals(
        heads, found.confidence, found.subjects, previous, settings.alignment, mirrored=settings.identity.mirrored
    )
    T_model_head = aligned.T_model_head @ T_model_head[aligned.kept]
    return replace(aligned, T_model_head=T_model_head), filled


def _spooled(
    subjects: Iterable[Subject], found: Survey, aligned: Aligned, previous: GNMData, spool: Spool, settings: Build
) -> _Samples:
    """Expressions of the neutrals that are kept, as displacements in the model's frame, unseen skin filled."""
    turns = dict(zip((found.subjects[k] for k in aligned.kept), aligned.T_model_head[:, :3, :3], strict=True))
    complete, looks = Completion(previous, previous.expression_basis, settings.unseen), Looks(previous)
    names, of, labels, figures, filled = [], [], [], [], 0
    for subject in subjects:
        if subject.name not in turns or subject.neutral is None:
            continue
        for mesh in subject.expressions:
            sure = np.minimum(mesh.confidence, subject.neutral.confidence)
            moved = (mesh.vertices.astype(np.float64) - subject.neutral.vertices) @ turns[subject.name].T
            filled += complete.unseen(sure)
            moved = complete(moved, sure)
            spool.append(moved)
            figures.append(looks.figures(moved, sure))
            names.append(f"{subject.name}, {mesh.name}")
            of.append(subject.name)
            labels.append(mesh.label)
    kept, rejected = np.arange(len(names)), list[Rejected]()
    while len(kept) and (out := spoiled(np.stack(figures)[kept], "the neutral", settings.alignment)):
        rejected.append(Rejected(name=names[kept[out[0]]], reason=out[1]))
        kept = np.delete(kept, out[0])
    counts = Counter(of[k] for k in kept)
    weights = np.zeros(len(names))
    weights[kept] = [1 / counts[of[k]] for k in kept]
    return _Samples(subjects=tuple(of), labels=tuple(labels), weights=weights, rejected=tuple(rejected), filled=filled)


def _with_identity(previous: GNMData, head: HeadIdentity) -> GNMData:
    """The previous model with another head: template, identity, joints; each field in its own type."""
    kept = identity.carried(previous)
    regressor = joints.rebuilt(previous)
    joint_basis = np.einsum("jv,kvc->kjc", regressor, head.basis, optimize=True)
    names = [f"head_{k:03d}" for k in range(len(head.basis))] + previous.identity_names[kept].tolist()
    return _replaced(
        previous,
        template_vertex_positions=head.template,
        template_joint_positions=regressor @ head.template,
        vertex_identity_basis=np.concatenate([head.basis, previous.vertex_identity_basis[kept]]),
        joint_identity_basis=np.concatenate([joint_basis, previous.joint_identity_basis[kept]]),
        identity_names=np.array(names),
        joint_regressor=regressor,
    )


def _with_expressions(data: GNMData, bases: Mapping[str, Region], found: Coefficients) -> GNMData:
    kept = expression.carried(data)
    names = [*found.names, *data.expression_names[kept].tolist()]
    basis = np.concatenate([*(region.basis for region in bases.values()), data.expression_basis[kept]])
    return _replaced(data, expression_basis=basis, expression_names=np.array(names))


def _replaced(data: GNMData, **arrays: np.ndarray) -> GNMData:
    numbers: dict[str, Any] = {
        name: array if array.dtype.kind == "U" else array.astype(getattr(data, name).dtype)
        for name, array in arrays.items()
    }
    return replace(data, **numbers)
