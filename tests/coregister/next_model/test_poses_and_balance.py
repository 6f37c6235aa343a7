"""A built model depends neither on the heads' poses nor on how many expressions each subject performed."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from coregister.next_model.build import BuiltModel, build_model
from coregister.next_model.recipes import few_registrations
from coregister.next_model.training_data import TrainingMesh, TrainingSubject
from tests.coregister.next_model import samples

LABELS = ("smile", "jaw_left", "brows_up")
_RECIPE = few_registrations()
RECIPE = replace(
    _RECIPE, name="own", identity=replace(_RECIPE.identity, shrinkage=0.2, max_components=2, eyelids_follow=False)
)


@pytest.fixture(scope="module")
def subjects(head_assembly, model) -> list[TrainingSubject]:
    return samples.subjects(head_assembly, model, range(900, 903), LABELS)


@pytest.fixture(scope="module")
def built(subjects, model) -> BuiltModel:
    return build_model(subjects, model, RECIPE)


def _posed(mesh: TrainingMesh, rotation: Rotation) -> TrainingMesh:
    return replace(mesh, vertices=(rotation.apply(mesh.vertices) + (0.3, -1.0, 2.0)).astype(np.float32))


def test_the_model_does_not_depend_on_poses(built, subjects, model):
    """Each subject as a whole turned by a quarter, about another axis: expressions turn with their neutral."""
    turned = [
        replace(
            subject,
            neutral=_posed(subject.neutral, rotation),
            expressions=tuple(_posed(mesh, rotation) for mesh in subject.expressions),
        )
        for subject, rotation in zip(subjects, Rotation.from_rotvec(np.pi / 2 * np.eye(3)), strict=True)
    ]
    again = build_model(turned, model, RECIPE)
    assert len(again.data.expression_basis) == len(built.data.expression_basis)
    for name in ("template_vertex_positions", "vertex_identity_basis", "expression_basis"):
        np.testing.assert_allclose(getattr(again.data, name), getattr(built.data, name), atol=2e-5)


def test_subjects_count_alike(built, subjects, model):
    """One subject performs every expression three times."""
    often = replace(
        subjects[0],
        expressions=tuple(
            replace(mesh, name=f"{mesh.name} {number}") for number in range(3) for mesh in subjects[0].expressions
        ),
    )
    again = build_model([often, *subjects[1:]], model, RECIPE)
    assert again.manifest["subjects"][0]["expressions"] == 3 * len(LABELS)
    np.testing.assert_allclose(again.data.expression_basis, built.data.expression_basis, atol=2e-6)
    np.testing.assert_allclose(again.coefficients.covariance, built.coefficients.covariance, atol=1e-3)
