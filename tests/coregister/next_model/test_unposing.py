"""Expressions of heads that turned on their necks: joints at rest, the skull where the neutral has it."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from coregister.next_model.expression import RegionBasis, regional_bases
from coregister.next_model.training_data import TrainingSubject, skull_weights, unpose, unposed_expression
from registration.frames import axis_angle_to_matrix
from registration.model import regions
from registration.model.gnm import GNM
from registration.model.gnm_npz import GNMData
from registration.stabilize.automatic import AlignedExpressions, stabilize_subject
from registration.stabilize.subject_meshes import SkullSkin, SubjectMeshes
from registration.types import Parameters, Registration
from tests.coregister.next_model import samples

LABELS = ("smile", "jaw_open", "viseme_ee", "pucker", "brows_up", "sadness")
HEAD = 1  # the joint
TURN_DEG = 5.0  # rms of the expressions' angles


@pytest.fixture(scope="module")
def function(model) -> GNM:
    return GNM(model)


@pytest.fixture(scope="module")
def subjects(head_assembly, model) -> list[TrainingSubject]:
    return samples.subjects(head_assembly, model, range(800, 804), LABELS)


def _posed(vertices: np.ndarray, turn: np.ndarray, function: GNM, model: GNMData, seed: int) -> Registration:
    """A registration whose bind pose has these vertices, the head turned on its neck, the body anywhere."""
    rng = np.random.default_rng(seed)
    pose = function.neutral()
    rotations = pose.rotations.clone()
    rotations[HEAD] = torch.as_tensor(turn)
    rotations[0] = torch.as_tensor(rng.normal(0, 0.2, 3))
    parameters = replace(pose, rotations=rotations, translation=torch.as_tensor(rng.normal(0, 0.1, 3)).float())
    return _registration(parameters, torch.as_tensor(vertices - model.template_vertex_positions), function)


def _registration(parameters: Parameters, offsets: torch.Tensor, function: GNM) -> Registration:
    vertices = function(parameters, offsets).numpy()
    arrays = {name: getattr(parameters, name).numpy() for name in ("identity", "expression", "rotations")}
    return Registration(
        status="converged",
        reason="",
        **arrays,
        translation=parameters.translation.numpy(),
        scale=parameters.scale.numpy(),
        offsets=offsets.numpy(),
        vertices=vertices,
        triangles=function.triangles.numpy().astype(np.int32),
        confidence=np.ones(len(vertices), np.float32),
        texture=np.zeros((2, 2, 3), np.float32),
        corner_uvs=np.zeros((len(function.triangles), 3, 2), np.float32),
    )


def _turned(
    subject: TrainingSubject, function: GNM, model: GNMData
) -> tuple[Registration, list[Registration], AlignedExpressions]:
    """Registrations of a subject whose head turns on its neck, and their stabilized expressions."""
    rng = np.random.default_rng([int(subject.name[-4:]), 3])
    turns = np.radians(TURN_DEG) * rng.normal(size=(1 + len(LABELS), 3)) / np.sqrt(3)
    neutral, *others = [
        _posed(mesh.vertices, turn, function, model, seed)
        for seed, (mesh, turn) in enumerate(zip((subject.neutral, *subject.expressions), turns, strict=True))
    ]
    meshes = SubjectMeshes(
        subject=subject.name,
        neutral=neutral.vertices,
        neutral_confidence=neutral.confidence,
        names=LABELS,
        labels=LABELS,
        vertices=np.stack([other.vertices for other in others]),
        confidence=np.stack([other.confidence for other in others]),
    )
    return neutral, others, stabilize_subject(meshes, SkullSkin.from_model(model))


def test_an_expression_is_put_onto_the_unposed_neutral(subjects, function, model):
    neutral, others, aligned = _turned(subjects[0], function, model)
    weights = skull_weights(model)
    rest = unpose(neutral, function).astype(np.float64)
    skin = regions.skin(model)
    for other, vertices, T, mesh in zip(
        others, aligned.vertices, aligned.T_neutral_expression, subjects[0].expressions, strict=True
    ):
        result = unposed_expression(other, vertices, T, neutral, function, weights)
        displacement = result - rest
        truth = mesh.vertices.astype(np.float64) - subjects[0].neutral.vertices
        error = np.linalg.norm(displacement - truth, axis=1)[skin]
        print(f"{mesh.label}: {1e3 * np.sqrt((error**2).mean()):.2f} mm")  # what stabilization leaves of the skull
        assert np.sqrt((error**2).mean()) < 0.5e-3


def test_what_stabilization_removed_from_a_region_stays_removed(subjects, function, model):
    neutral, others, aligned = _turned(subjects[1], function, model)
    weights, T = skull_weights(model), aligned.T_neutral_expression[0]
    as_stabilized = unposed_expression(others[0], aligned.vertices[0], T, neutral, function, weights)
    nose = (regions.group(model, "nose_region") > 0.5)[:, None]
    dropped = (aligned.vertices[0] - np.float32([0, 0, 4e-3]) * nose).astype(np.float32)
    without = unposed_expression(others[0], dropped, T, neutral, function, weights)
    posed = neutral.vertices.astype(np.float64)
    rest = unpose(neutral, function).astype(np.float64)
    rotation, _ = Rotation.align_vectors(
        rest - np.average(rest, axis=0, weights=weights), posed - np.average(posed, axis=0, weights=weights), weights
    )
    assert rotation.magnitude() > 0.1  # otherwise its direction would not matter
    np.testing.assert_allclose(without - as_stabilized, rotation.apply([0, 0, -4e-3]) * nose, atol=2e-6)


def _neck_energy(basis: RegionBasis, model: GNMData) -> float:
    energy = (basis.basis**2).sum((0, 2))
    return float(energy[regions.neck_other(model)].sum() / energy[regions.skin(model)].sum())


def test_turns_of_the_neck_do_not_enter_the_lower_face(subjects, function, model):
    weights = skull_weights(model)
    unposed, posed = [], []
    for subject in subjects:
        neutral, others, aligned = _turned(subject, function, model)
        rest = unpose(neutral, function)
        for other, vertices, T in zip(others, aligned.vertices, aligned.T_neutral_expression, strict=True):
            unposed.append(unposed_expression(other, vertices, T, neutral, function, weights) - rest)
            posed.append(vertices - neutral.vertices)
    truth = [mesh.vertices - subject.neutral.vertices for subject in subjects for mesh in subject.expressions]
    shares = {}
    for name, displacements in (("as posed", posed), ("unposed", unposed), ("true", truth)):
        basis = regional_bases(displacements, np.ones(len(displacements)), model)["lower_face_region"]
        shares[name] = _neck_energy(basis, model)
    print(shares)
    assert shares["unposed"] <= 0.02


def test_unposing_a_registration(model):
    function, rng = GNM(model), np.random.default_rng(0)
    pose = function.neutral()
    parameters = replace(
        pose,
        identity=torch.as_tensor(rng.normal(size=len(pose.identity)).astype(np.float32)),
        rotations=torch.as_tensor(rng.normal(0, 0.2, pose.rotations.shape).astype(np.float32)),
        translation=torch.tensor([0.1, -1.0, 0.3]),
        scale=torch.tensor(1.1),
    )
    offsets = torch.as_tensor(rng.normal(0, 1e-3, model.template_vertex_positions.shape).astype(np.float32))
    at_rest = replace(parameters, rotations=pose.rotations, translation=pose.translation)
    registration = _registration(parameters, offsets, function)
    unposed = unpose(registration, function)
    np.testing.assert_allclose(unposed, function(at_rest, offsets).numpy(), atol=1e-7)
    # Posing it again gives the registration.
    joints = parameters.scale * function.joints(parameters.identity)
    again = function.pose(torch.as_tensor(unposed), joints, axis_angle_to_matrix(parameters.rotations))
    np.testing.assert_allclose(again + parameters.translation, registration.vertices, atol=2e-6)
