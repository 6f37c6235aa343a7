"""What a model is built from: subjects' meshes, checked before anything is computed."""

from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int

from registration.errors import InputError
from registration.geometry.rigid import align
from registration.model.gnm import GNM
from registration.model.gnm_npz import GNMData, topology_hash
from registration.storage.hashing import hash_arrays
from registration.types import Parameters, Registration

NEUTRAL = "neutral"  # the label of neutrals


@dataclass(frozen=True, kw_only=True, eq=False)
class Mesh:
    """One registration: vertices in the model's order, metres, anywhere."""

    name: str
    label: str  # what was performed
    vertices: Float[np.ndarray, "V 3"]
    confidence: Float[np.ndarray, "V"]  # 0: seen by no camera
    triangles: Int[np.ndarray, "F 3"]
    digest: str = ""  # of what it was read from; of its arrays if that is not known


@dataclass(frozen=True, kw_only=True, eq=False)
class Subject:
    """A neutral, and expressions as stabilization leaves them: in the neutral's world, the skull where it has it."""

    name: str
    neutral: Mesh | None  # None is refused, by name
    expressions: tuple[Mesh, ...] = ()
    tags: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True, kw_only=True, eq=False)
class Survey:
    """What there is, after a first look at every mesh."""

    subjects: tuple[str, ...]
    neutrals: Float[np.ndarray, "N V 3"]  # float32
    confidence: Float[np.ndarray, "N V"]  # float32
    digests: Mapping[str, str]  # mesh -> what it was read from
    tags: tuple[Mapping[str, Any], ...]


def unposed(registration: Registration, model: GNM) -> Float[np.ndarray, "V 3"]:
    """A registration without its rotations: the bind pose with offsets, in its own scale, metres, the model's frame.

    A neutral whose neck is bent would teach the identity basis to bend it.
    """
    with torch.no_grad():
        take = {name: torch.as_tensor(getattr(registration, name)) for name in ("identity", "expression", "scale")}
        pose = model.neutral()
        parameters = Parameters(**take, rotations=pose.rotations, translation=pose.translation)
        vertices = model(parameters, torch.as_tensor(registration.offsets))
    return np.asarray(vertices.numpy(), np.float32)


def onto_unposed(
    expression: Float[np.ndarray, "V 3"],
    neutral: Float[np.ndarray, "V 3"],
    bare: Float[np.ndarray, "V 3"],
    weights: Float[np.ndarray, "V"],
) -> Float[np.ndarray, "V 3"]:
    """A stabilized expression, in the world of its registered neutral, as the same displacement of `unposed`'s neutral.

    `bare`: that neutral unposed. The displacement is turned as `weights`, of the skin on the skull, were turned.
    """
    turn = align(neutral[None].astype(np.float64), bare.astype(np.float64), weights[None])[0, :3, :3]
    return np.asarray(bare + (expression.astype(np.float64) - neutral) @ turn.T, np.float32)


def survey(
    subjects: Iterable[Subject],
    data: GNMData,
    *,
    labels: Collection[str] | None = None,
    least: int = 2,
    rank: int | None = None,
    previous: int = 0,
    mirrored: bool = False,
) -> Survey:
    """Read every mesh once, keep the neutrals.

    Args:
        labels: all that an expression may be labelled; any if None.
        least: neutrals without which nothing is built.
        rank: identity components asked for, which neutrals and `previous` components of the model must span.
        mirrored: mirror images of neutrals count too.

    Raises:
        InputError: a subject without a neutral, or twice; a mesh of another topology, with numbers that are not finite
            or with confidence out of range; an unknown label; too few neutrals.
    """
    topology = topology_hash(data.triangles)
    names, neutrals, sure, tags = [], [], [], []
    digests: dict[str, str] = {}
    for subject in subjects:
        if subject.neutral is None:
            raise InputError(
                "A subject has no neutral",
                where=subject.name,
                expected="a registration of the neutral face: expressions are displacements from it",
                got=f"{len(subject.expressions)} expressions only",
                fix="register the subject's neutral, or leave the subject out",
            )
        if subject.name in names:
            raise _wrong("A subject comes twice", subject.name, "one name a subject", "two", "give each its own name")
        for mesh in (subject.neutral, *subject.expressions):
            where = f"{subject.name}, {mesh.name}"
            _check(where, mesh, topology, data)
            if mesh is not subject.neutral and labels is not None and mesh.label not in labels:
                expected = ", ".join(sorted(labels))
                raise _wrong("A label is unknown", where, expected, mesh.label, "correct the label, or add it")
            digests[where] = mesh.digest or hash_arrays(mesh.vertices, mesh.confidence)
        names.append(subject.name)
        neutrals.append(subject.neutral.vertices.astype(np.float32))
        sure.append(subject.neutral.confidence.astype(np.float32))
        tags.append(subject.tags)
    _check_count(len(names), least, rank, previous, mirrored)
    return Survey(
        subjects=tuple(names),
        neutrals=np.stack(neutrals),
        confidence=np.stack(sure),
        digests=digests,
        tags=tuple(tags),
    )


def _check(where: str, mesh: Mesh, topology: str, data: GNMData) -> None:
    count = len(data.template_vertex_positions)
    if topology_hash(mesh.triangles) != topology or mesh.vertices.shape != (count, 3):
        raise _wrong(
            "A mesh has another topology than the model",
            where,
            f"the model's {count} vertices and {len(data.triangles)} triangles",
            f"{len(mesh.vertices)} vertices and {len(mesh.triangles)} triangles, or another order",
            "register all subjects with one model, and give that model",
        )
    for name in ("vertices", "confidence"):
        if bad := np.count_nonzero(~np.isfinite(getattr(mesh, name))):
            what = f"A mesh's {name} are not finite"
            raise _wrong(what, where, "finite numbers", f"{bad} NaN or infinite", "register it again, or leave it out")
    if mesh.confidence.shape != (count,) or mesh.confidence.min() < 0 or mesh.confidence.max() > 1:
        got = f"{mesh.confidence.shape}, {mesh.confidence.min()} to {mesh.confidence.max()}"
        raise _wrong(
            "A mesh's confidence is out of range", where, f"{count} numbers in [0, 1]", got, "register it again"
        )


def _check_count(neutrals: int, least: int, rank: int | None, previous: int, mirrored: bool) -> None:
    if neutrals < least:
        fix = "register more subjects"
        raise _wrong("There are too few neutrals", "subjects", f"at least {least}", neutrals, fix)
    most = (2 * neutrals if mirrored else neutrals) - 1 + previous
    if rank is not None and not 0 < rank <= most:
        images = " and their mirror images" if mirrored else ""
        raise _wrong(
            "There are too few samples for the rank that is asked for",
            "components of the head's identity",
            f"1 to {most}: {neutrals} neutrals{images} about their mean, {previous} of the previous model",
            rank,
            "register more subjects, or ask for fewer components",
        )


def _wrong(what: str, where: object, expected: object, got: object, fix: str) -> InputError:
    return InputError(what, where=where, expected=expected, got=got, fix=fix)
