"""The eyes' and pupils' components in both models."""

from dataclasses import replace

import numpy as np
import pytest

from coregister.anatomy import eye_sections
from coregister.anatomy.eyes import EyeSettings, eye_basis, pupils_basis
from coregister.anatomy.part_basis import PartBasis
from registration.anatomy.eye_structure import Eye, find_eyes
from registration.errors import InputError
from registration.model.gnm_npz import GNMData

FEW = EyeSettings(samples=600)


def in_frame(data: GNMData, basis: PartBasis, eye: Eye) -> tuple[np.ndarray, np.ndarray]:
    """Template and components of one eye, in its own frame and in the order of its structure."""
    rows = np.searchsorted(basis.vertices, eye.vertices)
    template = basis.template if basis.template is not None else data.template_vertex_positions[basis.vertices]
    return eye.to_own(template[rows] - eye.centre), eye.to_own(basis.components[:, rows])


def test_components_are_those_of_the_samples(any_model: GNMData) -> None:
    """Over the samples, the coefficients that fit the exterior's true points have unit variance."""
    basis, eyes = eye_basis(any_model, FEW), find_eyes(any_model)
    rest, components = in_frame(any_model, basis, eyes.left)
    modes = eye_sections.section_modes(FEW.samples, 3, np.random.default_rng(0), eyes.sclera_radius)
    assert basis.record["rejected"] == modes.rejected and basis.record["samples"] == 600
    outer = np.flatnonzero(eyes.exterior)
    angles = modes.reference_angles(eyes.polar_angle[outer])
    points = eye_sections.surface(angles, modes.limbus, modes.cornea, eyes.sclera_radius)
    points = points[..., :1] * eyes.outward[outer] + points[..., 1:] * [0, 0, 1]
    assert points.mean(0) == pytest.approx(rest[outer], abs=1e-9)
    coefficients = (points - rest[outer]).reshape(len(points), -1) @ np.linalg.pinv(components[:, outer].reshape(3, -1))
    assert coefficients.std(0)[:2] == pytest.approx([1, 1], abs=0.02)
    residual = points - rest[outer] - np.einsum("sk,knc->snc", coefficients, components[:, outer])
    assert np.sqrt((residual**2).sum(2).mean()) < 3e-6
    assert basis.record["variance_kept"] > 0.99


def test_both_eyes_move_alike_and_nothing_behind_moves(any_model: GNMData) -> None:
    basis, eyes = eye_basis(any_model, FEW), find_eyes(any_model)
    left, right = (in_frame(any_model, basis, eye)[1] for eye in (eyes.left, eyes.right))
    assert np.abs(left - right).max() < 1e-12
    assert np.abs(left[:, eyes.polar_angle > eye_sections.FIXED_FROM]).max() < 1e-12
    assert np.linalg.norm(left, axis=2).max() > 0.3e-3
    assert (left[:, eyes.exterior & (eyes.polar_angle < 0.1), 2] > 0)[0].all()  # a longer eye


def test_the_iris_grows_with_the_limbus_and_stays_inside(any_model: GNMData) -> None:
    basis, eyes = eye_basis(any_model, FEW), find_eyes(any_model)
    rest, components = in_frame(any_model, basis, eyes.left)
    for coefficients in np.concatenate([2 * np.eye(3), -2 * np.eye(3)]):
        points = rest + np.einsum("k,knc->nc", coefficients, components)
        radius, angle = np.linalg.norm(points, axis=1), np.arctan2(np.hypot(*points.T[:2]), points[:, 2])
        outer = np.flatnonzero(eyes.exterior)[np.argsort(angle[eyes.exterior])]
        assert (radius < np.interp(angle, angle[outer], radius[outer]) - 0.05e-3)[~eyes.exterior].all()


def test_the_template_may_be_kept(any_model: GNMData) -> None:
    assert eye_basis(any_model, replace(FEW, mean_template=False)).template is None


def test_the_seed_decides(first_model: GNMData) -> None:
    first, again, other = (eye_basis(first_model, replace(FEW, seed=seed)).components for seed in (1, 1, 2))
    assert (first == again).all() and not (first == other).all()


def test_the_pupil_is_a_point_half_and_the_whole_iris(any_model: GNMData) -> None:
    basis, eyes = pupils_basis(any_model), find_eyes(any_model)
    assert basis.names == ("pupils_000",)
    for eye in (eyes.left, eyes.right):
        rest, (component,) = in_frame(any_model, basis, eye)
        radius = {c: np.hypot(*(rest + c * component).T[:2]) for c in (-3, 0, 3)}
        iris = radius[0][eyes.iris].max()
        edge = eyes.pupil & (radius[0] > 0.499 * iris)
        assert edge.sum() == 24
        assert radius[-3][eyes.pupil].max() < 1e-9
        assert radius[0][edge] == pytest.approx(iris / 2, abs=1e-9)
        assert radius[3][edge] == pytest.approx(iris, abs=1e-9)
        assert np.abs(component[~eyes.iris]).max() == 0
        assert (np.diff(radius[3][eyes.iris & ~eyes.pupil]) < iris).all()
    assert basis.record["template_moved_mm"] < 0.15


def test_an_iris_without_rings_is_refused(first_model: GNMData) -> None:
    eyes, template = find_eyes(first_model), first_model.template_vertex_positions.copy()
    for eye in (eyes.left, eyes.right):
        pupil = eye.vertices[eyes.pupil]
        template[pupil, :2] = eye.centre[:2] + 0.7 * (template[pupil, :2] - eye.centre[:2])
    with pytest.raises(InputError, match="not made of rings") as error:
        pupils_basis(replace(first_model, template_vertex_positions=template))
    assert "0.891 mm" in str(error.value)


def test_eyes_of_another_size_and_bad_settings_are_refused(first_model: GNMData) -> None:
    small = replace(first_model, template_vertex_positions=first_model.template_vertex_positions / 2)
    with pytest.raises(InputError, match="no human size"):
        eye_basis(small)
    for bad in (EyeSettings(samples=3), EyeSettings(components=0), EyeSettings(seed=-1)):
        with pytest.raises(InputError):
            eye_basis(first_model, bad)
