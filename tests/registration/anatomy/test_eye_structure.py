"""The eyes' structure in both models, and what is refused."""

from dataclasses import replace

import numpy as np
import pytest

from registration.anatomy.eye_structure import FLIP, find_eyes
from registration.errors import InputError
from registration.model.gnm_npz import GNMData


def with_eye(data: GNMData, change, eyes=("left",)) -> GNMData:
    """The model with eyes whose vertices, in their own frame, are changed."""
    structure, template = find_eyes(data), data.template_vertex_positions.astype(np.float64)
    for name in eyes:
        eye = getattr(structure, name)
        own = eye.to_own(template[eye.vertices] - eye.centre)
        template[eye.vertices] = eye.centre + eye.to_model(change(own))
    return replace(data, template_vertex_positions=template.astype(np.float32))


def test_the_first_models_eyes_are_those_it_was_built_with(first_model: GNMData) -> None:
    eyes = find_eyes(first_model)
    assert eyes.sclera_radius == pytest.approx(14.6e-3, abs=1e-8)
    assert eyes.left.axis == pytest.approx([0, 0, 1], abs=1e-5)
    joints = dict(zip(first_model.joint_names.tolist(), first_model.template_joint_positions, strict=True))
    assert eyes.left.centre == pytest.approx(joints["left_eye"], abs=1e-6)
    assert eyes.right.centre == pytest.approx(joints["right_eye"], abs=1e-6)
    assert max(eyes.left.deviation, eyes.right.deviation, eyes.asymmetry) < 1e-6
    assert np.degrees(np.unique(eyes.polar_angle[eyes.exterior].round(5)))[:4] == pytest.approx(
        [0, 6, 12, 18], abs=1e-2
    )
    assert eyes.exterior.sum() == 314 and eyes.iris.sum() == 121 and eyes.pupil.sum() == 49


def test_the_gnm_files_eyes(gnm_model: GNMData) -> None:
    eyes = find_eyes(gnm_model)
    assert eyes.sclera_radius == pytest.approx(14.6e-3, abs=2e-6)
    assert np.degrees(np.arccos(eyes.left.axis[2])) < 0.1
    assert 0.02e-3 < max(eyes.left.deviation, eyes.right.deviation) < 0.15e-3
    assert eyes.asymmetry < 0.05e-3
    assert eyes.exterior.sum() == 386 and eyes.iris.sum() == 145


def test_an_axis_that_was_turned_is_found(first_model: GNMData) -> None:
    angle = np.radians(7.0)  # outwards, as the eyes of people are
    turn = np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])
    template = first_model.template_vertex_positions.astype(np.float64)
    eyes = find_eyes(first_model)
    for eye, rotation in ((eyes.left, turn), (eyes.right, turn.T)):
        template[eye.vertices] = eye.centre + (template[eye.vertices] - eye.centre) @ rotation.T
    turned = find_eyes(replace(first_model, template_vertex_positions=template.astype(np.float32)))
    assert turned.left.axis == pytest.approx([np.sin(angle), 0, np.cos(angle)], abs=1e-5)
    assert turned.right.axis == pytest.approx(turned.left.axis * FLIP, abs=1e-12)
    assert turned.positions == pytest.approx(eyes.positions, abs=1e-7)


def test_displacements_go_into_an_eye_and_back(first_model: GNMData) -> None:
    eyes = find_eyes(first_model)
    own = np.random.default_rng(0).normal(size=(2, len(eyes.positions), 3))
    for eye in (eyes.left, eyes.right):
        assert eye.to_own(eye.to_model(own)) == pytest.approx(own, abs=1e-14)
    assert eyes.right.to_model(own) == pytest.approx(eyes.left.to_model(own) * FLIP, abs=1e-14)


@pytest.mark.parametrize(
    ("change", "eyes", "message", "figure"),
    [
        (lambda p: p * [1.05, 1, 1], ("left", "right"), "no sclera with a cornea", " mm from a sphere"),
        (
            lambda p: p + 0.25 * p[:, :1] * (np.linalg.norm(p, axis=1) > 14.62e-3)[:, None] * [1, 0, 0],
            ("left", "right"),
            "no surface of revolution",
            " mm, on the exterior at",
        ),
        (lambda p: p + [1e-3, 0, 0] * (p[:, 2:] > 0.012), ("left",), "differ from one another", " mm"),
        (
            lambda p: p * (14.6e-3 / np.maximum(np.linalg.norm(p, axis=1, keepdims=True), 14.6e-3)),
            ("left", "right"),
            "no sclera with a cornea",
            "a rise of 0.000 mm",
        ),
    ],
)
def test_eyes_of_another_shape_are_refused(first_model: GNMData, change, eyes, message: str, figure: str) -> None:
    with pytest.raises(InputError, match=message) as error:
        find_eyes(with_eye(first_model, change, eyes))
    assert figure in str(error.value)


def test_groups_that_do_not_fit_together_are_refused(first_model: GNMData) -> None:
    groups = first_model.vertex_groups.copy()
    groups[first_model.vertex_group_names.tolist().index("eye_interiors")] = 0
    with pytest.raises(InputError, match="do not fit together"):
        find_eyes(replace(first_model, vertex_groups=groups))


def test_eyes_that_do_not_mirror_are_refused(first_model: GNMData) -> None:
    with pytest.raises(InputError, match="no mirror images"):
        find_eyes(replace(first_model, mirror_indices=np.arange(len(first_model.mirror_indices), dtype=np.int32)))
