"""Build the next head model from registrations and the previous model [GNM, GNM].

    model = build_model(subjects, previous, few_registrations())
    provenance.write(model.data, model.manifest, model.coefficients, path, previous_path)

Neutrals are validated, completed and aligned; identity basis, joints and regional expression bases are computed from
them and from the stabilized expressions. Taken from the previous model are the mesh, skinning weights, vertex groups
and the components that move no skin: shapes of eyes and teeth, motions of tongue and pupils, which
`coregister.anatomy.assemble` replaces.
"""

from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Float

from coregister import joints
from coregister.next_model import expression, identity, size
from coregister.next_model.alignment import AlignedNeutrals, RejectedSubject, align_neutrals
from coregister.next_model.completion import MissingDataCompletion
from coregister.next_model.displacement_store import DisplacementStore
from coregister.next_model.expression import CoefficientStatistics, RegionBasis
from coregister.next_model.expression_outliers import ExpressionStatistics, reject_expressions
from coregister.next_model.identity import IdentityBasis
from coregister.next_model.provenance import BuildInputs, build_manifest
from coregister.next_model.recipes import ModelRecipe, few_registrations
from coregister.next_model.training_data import TrainingSet, TrainingSubject, validate_training_set
from registration.cranium.auxiliary_model import CraniumModel
from registration.cranium.complete import CraniumCompletion, CraniumSettings
from registration.frames import transform_points
from registration.geometry.rigid import align
from registration.model import gnm_npz
from registration.model.gnm_npz import GNMData
from registration.stabilize.subject_meshes import SkullSkin


@dataclass(frozen=True, kw_only=True, eq=False)
class BuiltModel:
    """A model and its provenance."""

    data: GNMData
    manifest: dict[str, Any]  # JSON values; docs/formats.md
    coefficients: CoefficientStatistics | None  # of the expressions; None: no expressions, the basis is the previous


def build_model(
    subjects: Iterable[TrainingSubject],
    previous: GNMData,
    recipe: ModelRecipe | None = None,
    *,
    categories: Mapping[str, str] | None = None,
    cranium: CraniumModel | None = None,
    prior: GNMData | None = None,
) -> BuiltModel:
    """Build the next model. Deterministic.

    Args:
        subjects: read twice, one subject at a time: neutrals are held in memory, expressions on disk.
        previous: the model in whose topology the meshes are.
        recipe: all settings; None: `recipes.few_registrations()`, as `gnmreg coregister` uses.
        categories: every permitted label of an expression -> its category; None: any label.
        cranium: completes unobserved craniums of neutrals, unless the recipe's `completion.cranium` is off; None: the
            previous model does.
        prior: the model that the identity basis is shrunk towards: of the same topology, and built from none of the
            subjects, as the first model of a coregistration is in every round. None: the previous one.

    Returns:
        The model, in the topology of the previous one, and its provenance.

    Raises:
        InputError: as `validate_training_set`, `size.check_recipe` and `size.check_disk`; a previous model without the
            official vertex groups.
    """
    recipe = recipe or few_registrations()
    training = validate_training_set(subjects, previous, labels=None if categories is None else {*categories})
    prior = previous if prior is None else prior
    size.check_recipe(len(training.subjects), training.expression_count, prior, recipe)
    size.check_disk(training.expression_count, len(previous.template_vertex_positions))
    aligned, completed = _align(training, previous, recipe, cranium)
    head = identity.build_identity_basis(aligned.vertices, previous, recipe.identity, recipe.memory_gb, prior)
    data = _with_identity(previous, head)
    with DisplacementStore(training.expression_count, len(head.template)) as store:
        samples = _store_expressions(subjects, training, aligned, previous, store, recipe)
        bases, coefficients = dict[str, RegionBasis](), None
        if samples.weights.any():
            bases = expression.regional_bases(store, samples.weights, data, recipe.expressions, recipe.memory_gb)
            coefficients = expression.coefficient_statistics(store, samples.weights, bases, data)
            data = _with_expressions(data, bases, coefficients)
    inputs = BuildInputs(
        training=training,
        prior=gnm_npz.content_hash(prior),
        aligned=aligned,
        head=head,
        bases=bases,
        expression_subjects=samples.subjects,
        expression_labels=samples.labels,
        expression_weights=samples.weights,
        rejected=(*aligned.rejected, *samples.rejected),
        completed={"neutrals": completed, "expressions": samples.completed},
        categories=categories,
    )
    return BuiltModel(data=data, manifest=build_manifest(inputs, previous, data, recipe), coefficients=coefficients)


@dataclass(frozen=True, kw_only=True)
class _TrainingSamples:
    """The expressions in the store, in its order."""

    subjects: tuple[str, ...]
    labels: tuple[str, ...]
    weights: Float[np.ndarray, "S"]  # 1 / number of the subject's expressions; 0: excluded
    rejected: tuple[RejectedSubject, ...]
    completed: int  # samples with missing data


def _align(
    training: TrainingSet, previous: GNMData, recipe: ModelRecipe, cranium: CraniumModel | None
) -> tuple[AlignedNeutrals, int]:
    """Completed and aligned neutrals, and the number of those with missing data. Overwrites the training neutrals."""
    stable, template = SkullSkin.from_model(previous).area, previous.template_vertex_positions.astype(np.float64)
    T_model_head = align(training.neutrals, template, training.confidence * stable)
    complete = MissingDataCompletion(previous, previous.vertex_identity_basis, recipe.completion)
    of_cranium = None
    if cranium is not None and recipe.completion.cranium == "model":
        settings = CraniumSettings(min_confidence=recipe.completion.min_confidence)
        of_cranium = CraniumCompletion(previous, cranium, settings)
    # Completed heads take the place of the neutrals, which nobody needs afterwards: thousands are gigabytes.
    heads, completed = training.neutrals, 0
    rows = zip(T_model_head, heads, training.confidence, strict=True)
    for index, (T, vertices, confidence) in enumerate(rows):
        head, known = transform_points(T, vertices.astype(np.float64)), confidence
        if of_cranium is not None and (whole := of_cranium(head, confidence)) is not None:
            head = whole.vertices  # what it completes is no longer missing: the previous model does the rest
            known = np.where(whole.hidden, np.float32(recipe.completion.min_confidence), confidence)
        heads[index] = template + complete(head - template, known)
        completed += complete.has_missing(confidence)
    aligned = align_neutrals(
        heads,
        training.confidence,
        training.subjects,
        previous,
        recipe.alignment,
        mirrored=recipe.identity.mirrored,
    )
    T_model_head = aligned.T_model_head @ T_model_head[aligned.kept]
    return replace(aligned, T_model_head=T_model_head), completed


def _store_expressions(
    subjects: Iterable[TrainingSubject],
    training: TrainingSet,
    aligned: AlignedNeutrals,
    previous: GNMData,
    store: DisplacementStore,
    recipe: ModelRecipe,
) -> _TrainingSamples:
    """Writes completed expressions of all kept subjects into the store, as displacements in the model's frame."""
    kept_names = (training.subjects[k] for k in aligned.kept)
    rotations = dict(zip(kept_names, aligned.T_model_head[:, :3, :3], strict=True))
    complete = MissingDataCompletion(previous, previous.expression_basis, recipe.completion)
    statistics = ExpressionStatistics(previous)
    names, owners, labels, values, completed = [], [], [], [], 0
    for subject in subjects:
        if subject.name not in rotations or subject.neutral is None:
            continue
        rotation = rotations[subject.name]
        neutral = subject.neutral.vertices.astype(np.float64) @ rotation.T
        for mesh in subject.expressions:
            confidence = np.minimum(mesh.confidence, subject.neutral.confidence)
            displacement = mesh.vertices.astype(np.float64) @ rotation.T - neutral
            completed += complete.has_missing(confidence)
            displacement = complete(displacement, confidence)
            store.append(displacement)
            values.append(statistics(neutral, displacement, confidence, mesh.figures))
            names.append(f"{subject.name}, {mesh.name}")
            owners.append(subject.name)
            labels.append(mesh.label)
    kept, rejected = reject_expressions(values, labels, names, recipe.alignment)
    counts = Counter(owners[k] for k in kept)
    weights = np.zeros(len(names))
    weights[kept] = [1 / counts[owners[k]] for k in kept]
    return _TrainingSamples(
        subjects=tuple(owners),
        labels=tuple(labels),
        weights=weights,
        rejected=rejected,
        completed=completed,
    )


def _with_identity(previous: GNMData, head: IdentityBasis) -> GNMData:
    """The previous model with another template, identity basis and joints."""
    transferred = identity.transfer_components(previous)
    regressor = joints.rebuild_regressor(previous)
    joint_basis = np.einsum("jv,kvc->kjc", regressor, head.basis, optimize=True)
    names = [f"head_{k:03d}" for k in range(len(head.basis))] + previous.identity_names[transferred].tolist()
    return _replace_arrays(
        previous,
        template_vertex_positions=head.template,
        template_joint_positions=regressor @ head.template,
        vertex_identity_basis=np.concatenate([head.basis, previous.vertex_identity_basis[transferred]]),
        joint_identity_basis=np.concatenate([joint_basis, previous.joint_identity_basis[transferred]]),
        identity_names=np.array(names),
        joint_regressor=regressor,
    )


def _with_expressions(data: GNMData, bases: Mapping[str, RegionBasis], coefficients: CoefficientStatistics) -> GNMData:
    """The model with another expression basis."""
    transferred = expression.transfer_components(data)
    names = [*coefficients.names, *data.expression_names[transferred].tolist()]
    basis = np.concatenate([*(region.basis for region in bases.values()), data.expression_basis[transferred]])
    return _replace_arrays(data, expression_basis=basis, expression_names=np.array(names))


def _replace_arrays(data: GNMData, **arrays: np.ndarray) -> GNMData:
    """The model with other arrays, each in the field's own numeric type."""
    converted: dict[str, Any] = {
        name: array if array.dtype.kind == "U" else array.astype(getattr(data, name).dtype)
        for name, array in arrays.items()
    }
    return replace(data, **converted)
