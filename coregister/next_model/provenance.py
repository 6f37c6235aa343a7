"""Provenance of a built model: its manifest, and the files beside the model file (docs/formats.md, "Built models")."""

import shutil
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from coregister.next_model import eyelids
from coregister.next_model.alignment import AlignedNeutrals, RejectedSubject
from coregister.next_model.expression import CoefficientStatistics, RegionBasis
from coregister.next_model.identity import IdentityBasis
from coregister.next_model.recipes import ModelRecipe
from coregister.next_model.training_data import TrainingSet
from coregister.tag_groups import tag_group
from registration.cranium import auxiliary_model
from registration.frames import MM_PER_M
from registration.model import gnm_npz, landmarks
from registration.model.gnm_npz import GNMData
from registration.stabilize.subject_meshes import SkullSkin
from registration.storage import hashing
from registration.storage.files import atomic_file, write_json

KIND = "gnm-model"
SCHEMA = 1


@dataclass(frozen=True, kw_only=True, eq=False)
class BuildInputs:
    """Data and intermediate results of a build that its manifest describes. M expressions."""

    training: TrainingSet
    prior: str  # content id of the model that the identity basis is shrunk towards
    aligned: AlignedNeutrals
    head: IdentityBasis
    bases: Mapping[str, RegionBasis]  # of expressions; empty: the previous model's basis is kept
    expression_subjects: Sequence[str]  # M
    expression_labels: Sequence[str]  # M
    expression_weights: np.ndarray  # M; 0: excluded
    rejected: Sequence[RejectedSubject]
    completed: Mapping[str, int]  # "neutrals", "expressions" -> number with missing data
    categories: Mapping[str, str] | None  # permitted label -> category; None: any label


def build_manifest(inputs: BuildInputs, previous: GNMData, data: GNMData, recipe: ModelRecipe) -> dict[str, Any]:
    """Return the manifest of a built model as JSON values.

    Args:
        inputs: of the build.
        previous: the model that it started from.
        data: the built model.
        recipe: the resolved settings.
    """
    digests = {**inputs.training.digests, "previous": gnm_npz.content_hash(previous), "prior": inputs.prior}
    config = {**hashing.to_jsonable(recipe), "categories": inputs.categories}
    manifest: dict[str, Any] = hashing.to_jsonable(
        {
            "kind": KIND,
            "schema": SCHEMA,
            "content_id": gnm_npz.content_hash(data),
            "input_hash": hashing.input_hash(digests, config),
            "inputs": digests,
            "config": config,
            "versions": hashing.versions(),
            "subjects": _subjects(inputs),
            "rejected": [vars(rejected) for rejected in inputs.rejected],
            "filled": inputs.completed,
            "alignment": {"rounds": inputs.aligned.iterations},
            "identity": _identity(inputs.head, data),
            "expression": {name: _components(region, region.energy) for name, region in inputs.bases.items()}
            or "the previous model's: there are no expressions",
            **_counts(inputs),
            "figures": _metrics(inputs.head, previous, data),
        }
    )
    return manifest


def write(
    data: GNMData,
    manifest: Mapping[str, Any],
    coefficients: CoefficientStatistics | None,
    path: Path,
    previous: Path,
) -> None:
    """Write the model file and, beside it, `NAME.manifest.json`, `NAME.expressions.npz`, and the landmark schemes and
    the auxiliary model of the cranium of the previous model. The model file is written last.

    Args:
        data: the model.
        manifest: of `build_manifest`.
        coefficients: of the regional expression components; None: no file.
        path: of the model file, NAME.npz.
        previous: the previous model's file.

    Raises:
        InputError: the data is no GNM model.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    for scheme in landmarks.schemes_beside(previous, data.template_vertex_positions).values():
        landmarks.write_scheme(scheme, path)
    cranium = auxiliary_model.beside(previous)
    if cranium.is_file() and cranium != auxiliary_model.beside(path):
        with atomic_file(auxiliary_model.beside(path)) as temporary:
            shutil.copyfile(cranium, temporary)
    if coefficients is not None:
        arrays = {"mean": coefficients.mean, "covariance": coefficients.covariance}
        with atomic_file(path.with_name(f"{path.stem}.expressions.npz")) as temporary:
            np.savez(temporary, allow_pickle=False, names=np.array(coefficients.names), **arrays)
    write_json(path.with_name(f"{path.stem}.manifest.json"), manifest)
    gnm_npz.write(data, path)


def drift_mm(previous: GNMData, data: GNMData) -> float:
    """Return the rms distance between two models' templates over the stable skin, mm, without alignment."""
    stable = SkullSkin.from_model(previous).area
    difference = data.template_vertex_positions.astype(np.float64) - previous.template_vertex_positions
    return float(MM_PER_M * np.sqrt((difference**2).sum(1) @ stable / stable.sum()))


def _subjects(inputs: BuildInputs) -> list[dict[str, Any]]:
    """One entry for every subject in the model."""
    training, aligned = inputs.training, inputs.aligned
    used = np.flatnonzero(inputs.expression_weights > 0).tolist()
    counts = Counter(inputs.expression_subjects[k] for k in used)
    return [
        {
            "subject": (name := training.subjects[k]),
            "tags": training.tags[k],
            "expressions": counts[name],
            "weight_of_each": 1 / counts[name] if counts[name] else 0.0,
            "residual_mm": residual,
        }
        for k, residual in zip(aligned.kept, aligned.residual_mm, strict=True)
    ]


def _identity(head: IdentityBasis, data: GNMData) -> dict[str, Any]:
    return {
        **_components(head, head.variance),
        "samples": 2 * head.head_count if head.mirrored else head.head_count,
        "weight_of_each": 0.5 if head.mirrored else 1.0,
        "shares_tried_mm": {f"{p:.2f}": MM_PER_M * rms for p, rms in head.shrinkage_scores.items()},
        "carried": data.identity_names[len(head.basis) :],
    }


def _components(basis: IdentityBasis | RegionBasis, variance: np.ndarray) -> dict[str, Any]:
    return {
        "components": len(variance),
        "share_kept": basis.variance_ratio,
        "share_previous": basis.shrinkage,
        "method": basis.method,
        "could_miss": basis.missed,
        "variance_mm2": MM_PER_M**2 * variance,
    }


def _counts(inputs: BuildInputs) -> dict[str, Any]:
    """Expressions by label and by category, subjects by tag."""
    used = np.flatnonzero(inputs.expression_weights > 0).tolist()
    labels = [inputs.expression_labels[k] for k in used]
    categories = inputs.categories or {}
    return {
        "labels": dict(sorted(Counter(labels).items())),
        "categories": dict(sorted(Counter(categories.get(label, label) for label in labels).items())),
        "demographics": _demographics([inputs.training.tags[k] for k in inputs.aligned.kept]),
    }


def _demographics(tags: Iterable[Mapping[str, Any]]) -> dict[str, dict[str, int]]:
    """Tag -> group -> number of subjects."""
    counts: dict[str, Counter[str]] = {}
    for subject_tags in tags:
        for name, value in subject_tags.items():
            counts.setdefault(name, Counter())[tag_group(value)] += 1
    return {name: dict(sorted(groups.items())) for name, groups in sorted(counts.items())}


def _metrics(head: IdentityBasis, previous: GNMData, data: GNMData) -> dict[str, Any]:
    template = data.template_vertex_positions.astype(np.float64)
    basis = data.vertex_identity_basis[: len(head.basis)]
    change = eyelids.gap_change_mm(eyelids.eyelid_rims(data), template, basis)
    return {
        "drift_mm": drift_mm(previous, data),
        "lid_gap_change_mm": {"worst": change.max(initial=0), "median": np.median(change) if len(change) else 0.0},
    }
