"""Many registrations and the previous model -> the next model, with how it came about (paper, GNM).

    built = build(subjects, previous)
    write(built, path, previous_path)

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

from coregister import expression, identity, joints, lids
from coregister.align import Aligned, Alignment, Looks, Rejected, align_neutrals, spoiled
from coregister.expression import Coefficients, Expressions, Region
from coregister.identity import HeadIdentity, Identity
from coregister.samples import Subject, Survey, survey
from coregister.spool import Spool
from coregister.unseen import Completion, Unseen
from registration import hashes
from registration.frames import MM_PER_M, transform_points
from registration.geometry.rigid import align
from registration.model import gnm_npz, regions
from registration.model.gnm_npz import GNMData
from registration.stabilize.meshes import SkullSkin

KIND = "gnm-model"
SCHEMA = 1


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
        previous=of_head if settings.identity.previous > 0 else 0,
    )
    aligned, filled = _aligned(found, previous, settings)
    head = identity.head_identity(aligned.vertices, previous, settings.identity, settings.memory_gb)
    data = _with_identity(previous, head)
    with Spool(len(head.template)) as spool:
        samples = _spooled(subjects, found, aligned, previous, spool, settings)
        kept = samples.weights > 0
        bases: dict[str, Region] = {}
        coefficients = None
        if kept.any():
            bases = expression.regional_bases(spool, samples.weights, data, settings.expressions, settings.memory_gb)
            coefficients = expression.coefficients(spool, samples.weights, bases, data)
            data = _with_expressions(data, bases, coefficients)
    manifest = _manifest(found, aligned, filled, head, bases, samples, previous, data, settings)
    return Built(data=data, manifest=manifest, coefficients=coefficients)


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
    aligned = align_neutrals(heads, found.confidence, found.subjects, previous, settings.alignment)
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
    numbers = {
        name: array if array.dtype.kind == "U" else array.astype(getattr(data, name).dtype)
        for name, array in arrays.items()
    }
    return replace(data, **numbers)


def _manifest(
    found: Survey,
    aligned: Aligned,
    filled: int,
    head: HeadIdentity,
    bases: Mapping[str, Region],
    samples: _Samples,
    previous: GNMData,
    data: GNMData,
    settings: Build,
) -> dict[str, Any]:
    inputs = {**found.digests, "previous": gnm_npz.content_hash(previous)}
    config = hashes.plain(settings)
    taken = [label for label, weight in zip(samples.labels, samples.weights, strict=True) if weight > 0]
    category = settings.categories or {}
    counted = Counter(of for of, weight in zip(samples.subjects, samples.weights, strict=True) if weight > 0)
    template = data.template_vertex_positions.astype(np.float64)
    both = lids.sockets(data)
    gap = lids.gap_change_mm(both, template, data.vertex_identity_basis[: len(head.basis)])
    return hashes.plain(
        {
            "kind": KIND,
            "schema": SCHEMA,
            "content_id": gnm_npz.content_hash(data),
            "input_hash": hashes.input_hash(inputs, config),
            "inputs": inputs,
            "config": config,
            "versions": hashes.versions(),
            "subjects": [
                {
                    "subject": found.subjects[k],
                    "tags": found.tags[k],
                    "expressions": counted[found.subjects[k]],
                    "weight_of_each": 1 / max(counted[found.subjects[k]], 1),
                    "residual_mm": residual,
                }
                for k, residual in zip(aligned.kept, aligned.residual_mm, strict=True)
            ],
            "rejected": [vars(one) for one in (*aligned.rejected, *samples.rejected)],
            "filled": {"neutrals": filled, "expressions": samples.filled},
            "alignment": {"rounds": aligned.rounds},
            "identity": {**_told(head), "previous_components": data.identity_names[len(head.basis) :]},
            "expression": {name: _told(region) for name, region in bases.items()}
            or {"previous": "all of it: there are no expressions"},
            "labels": dict(sorted(Counter(taken).items())),
            "categories": dict(sorted(Counter(category.get(label, label) for label in taken).items())),
            "demographics": _demographics([found.tags[k] for k in aligned.kept]),
            "figures": {
                "drift_mm": drift_mm(previous, data),
                "lid_gap_change_mm": {"worst": gap.max(initial=0), "median": np.median(gap) if len(gap) else 0.0},
            },
        }
    )


def drift_mm(previous: GNMData, data: GNMData) -> float:
    """rms distance of the stable skin between two models' templates, as they lie."""
    stable = SkullSkin.of(previous).area
    away = data.template_vertex_positions.astype(np.float64) - previous.template_vertex_positions
    return float(MM_PER_M * np.sqrt((away**2).sum(1) @ stable / stable.sum()))


def _told(part: HeadIdentity | Region) -> dict[str, Any]:
    variance = part.variance if isinstance(part, HeadIdentity) else part.energy
    return {
        "components": len(variance),
        "share_kept": part.share,
        "share_previous": part.previous,
        "method": part.method,
        "variance_mm2": MM_PER_M**2 * variance,
    }


def _demographics(tags: Iterable[Mapping[str, Any]]) -> dict[str, dict[str, int]]:
    """Tag -> value -> subjects; ages by decade."""
    counts: dict[str, Counter[str]] = {}
    for of in tags:
        for name, value in of.items():
            decade = isinstance(value, (int, float)) and not isinstance(value, bool)
            told = f"{10 * int(value // 10)}-{10 * int(value // 10) + 9}" if decade else str(value)
            counts.setdefault(name, Counter())[told] += 1
    return {name: dict(sorted(count.items())) for name, count in sorted(counts.items())}
