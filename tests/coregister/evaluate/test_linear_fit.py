"""Fits in correspondence: random heads of the model with all and with fewer components, in any pose."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from coregister.evaluate import linear_fit
from registration.model import gnm_npz, regions
from tests.coregister.spectrum import DEVIATIONS_MM, TINY, heads, spectrum_model, with_identity

RANKS = (2, 4, 8, 12)


@pytest.fixture(scope="module")
def model():
    return spectrum_model()


@pytest.fixture(scope="module")
def part(model):
    return linear_fit.identity_part(model)


def samples(model, part, count, seed=1):
    coefficients = np.random.default_rng(seed).standard_normal((count, len(part.basis)))
    return coefficients, heads(model, coefficients)[:, part.rows]


def transformed(points, seed=2):
    rotation = Rotation.from_rotvec([1.1, -1.9, 0.8])  # 2.3 rad, no small angle
    return rotation.apply(points) + np.random.default_rng(seed).normal(0, 1, 3)


def test_random_heads_are_recovered_in_any_pose(model, part):
    coefficients, shapes = samples(model, part, 5)
    for expected, shape in zip(coefficients, shapes, strict=True):
        for target in (shape, transformed(shape)):
            result = linear_fit.fit_correspondence(part, target, RANKS)[-1]
            assert result.converged
            assert result.distance_mm.max() < 1e-6
            np.testing.assert_allclose(result.coefficients, expected, atol=1e-6)
            np.testing.assert_allclose(
                result.T_model_world[:3, :3] @ result.T_model_world[:3, :3].T, np.eye(3), atol=1e-12
            )


def test_fewer_components_leave_the_residual_of_the_others(model, part):
    coefficients, shapes = samples(model, part, 200)
    rms = np.empty((len(shapes), len(RANKS)))
    for row, shape in enumerate(shapes):
        fits = linear_fit.fit_correspondence(part, shape, RANKS)
        rms[row] = [np.sqrt((fit.distance_mm**2).mean()) for fit in fits]
    for column, count in enumerate(RANKS):
        residual_mm = np.sqrt((coefficients[:, count:] ** 2 * DEVIATIONS_MM[count:] ** 2).sum(1))  # of this sample
        assert (rms[:, column] <= residual_mm + 1e-6).all()  # a rotation hardly reduces it
        np.testing.assert_allclose(rms[:, column], residual_mm, rtol=2e-3, atol=1e-6)
        expected = (DEVIATIONS_MM[count:] ** 2).sum()
        assert (rms[:, column] ** 2).mean() == pytest.approx(expected, rel=0.15, abs=1e-9)  # mean of 200 samples


@pytest.mark.parametrize("weighted", [False, True])
def test_fits_reach_the_least_squares_minimum_for_bases_that_are_not_orthogonal(weighted):
    part = linear_fit.identity_part(gnm_npz.read(TINY))
    if weighted:
        weights = np.random.default_rng(2).uniform(0.2, 1.8, len(part.rows))
        part = replace(part, weights=weights / weights.mean())
    off = part.gram / np.sqrt(np.outer(np.diag(part.gram), np.diag(part.gram)))
    assert np.abs(off - np.eye(len(off))).max() > 0.3  # otherwise a transpose would suffice
    rng = np.random.default_rng(3)
    target = transformed(part.shape(rng.normal(0, 1, len(part.basis))) + rng.normal(0, 2e-3, part.rest.shape))
    result = linear_fit.fit_correspondence(part, target, [4])[0]
    pose = result.T_model_world

    def residual(variables):
        aligned = Rotation.from_rotvec(variables[4:7]).apply(target @ pose[:3, :3].T + pose[:3, 3]) + variables[7:]
        return 1e3 * ((aligned - part.shape(variables[:4])) * part.scale).ravel()

    reference = least_squares(residual, np.r_[np.zeros(4), rng.normal(0, 1e-2, 6)], xtol=1e-12, ftol=1e-12, gtol=1e-12)
    assert len(part.rows) * part.mean(result.distance_mm**2) == pytest.approx(2 * reference.cost, rel=1e-8)
    np.testing.assert_allclose(result.coefficients, reference.x[:4], atol=1e-4)


def test_undetermined_coefficients_have_the_least_norm(model):
    twice = np.concatenate([model.vertex_identity_basis, model.vertex_identity_basis[:1]])
    doubled = with_identity(model, twice)
    part = linear_fit.identity_part(doubled)
    target = part.rest + part.basis[0]
    result = linear_fit.fit_correspondence(part, target, [len(part.basis)])[0]
    assert result.converged and result.distance_mm.max() < 1e-6
    assert result.coefficients[[0, -1]] == pytest.approx([0.5, 0.5], abs=1e-6)


def test_components_of_eyes_are_excluded(model):
    eyes = np.zeros((2, *model.template_vertex_positions.shape))
    eyes[:, regions.group(model, "left_eye") > 0.5] = 1e-3
    with_eyes = with_identity(model, np.concatenate([eyes[:1], model.vertex_identity_basis, eyes[1:]]))
    np.testing.assert_array_equal(linear_fit.identity_part(with_eyes).basis, linear_fit.identity_part(model).basis)


def test_expression_errors_are_those_of_their_region_alone(model):
    part = linear_fit.expression_parts(model)["lower_face"]
    coefficients = np.random.default_rng(4).standard_normal((50, 12))
    inside = np.zeros(len(model.template_vertex_positions), bool)
    inside[part.part.rows] = True
    assert (part.mask == 1).all()  # a hard mask; the next test has a soft one
    displacements = np.zeros((50, *model.template_vertex_positions.shape))
    displacements[:, part.part.rows] = np.tensordot(coefficients, part.part.basis, 1)
    result = part.errors_mm(displacements, RANKS)
    assert result[:, -1].max() < 1e-9
    first, targets = part.part.basis[:4].reshape(4, -1).T, displacements[:, part.part.rows].reshape(50, -1).T
    residual = targets - first @ np.linalg.lstsq(first, targets, rcond=None)[0]
    distances = np.linalg.norm(residual.T.reshape(50, -1, 3), axis=2)
    np.testing.assert_allclose(result[:, 1], 1e3 * distances.mean(1), rtol=1e-9)
    displacements[:, ~inside] += 1.0  # another region
    np.testing.assert_allclose(part.errors_mm(displacements, RANKS), result, atol=1e-12)


def test_a_soft_mask_weights_the_vertices_of_a_region(model):
    result = linear_fit.expression_parts(model)["lower_face"]
    mask = np.linspace(0.1, 1.0, len(result.mask))
    basis = result.part.basis * mask[:, None]
    soft = replace(result, mask=mask, part=replace(result.part, basis=basis))
    displacements = np.zeros((1, *model.template_vertex_positions.shape))
    displacements[:, result.part.rows] = result.part.basis[3]  # the mask is applied inside
    assert soft.errors_mm(displacements, [12]).max() < 1e-9
    empty = replace(soft, part=replace(soft.part, basis=np.zeros_like(basis)))
    displacements[:, result.part.rows] = (0.0, 3e-3, 0.0)
    assert empty.errors_mm(displacements, [1])[0, 0] == pytest.approx(3.0)


def test_variance_is_that_of_the_components(part):
    np.testing.assert_allclose(linear_fit.variance_mm2(part), DEVIATIONS_MM**2, rtol=1e-9)


def test_errors_of_both_eyes_are_equal_for_mirrored_displacements(model):
    data = gnm_npz.read(TINY)
    parts = linear_fit.expression_parts(data)
    rng = np.random.default_rng(5)
    left = rng.normal(0, 1e-3, (4, *data.template_vertex_positions.shape))
    right = left[:, data.mirror_indices] * (-1, 1, 1)
    np.testing.assert_allclose(
        parts["left_eye"].errors_mm(left, [1]), parts["right_eye"].errors_mm(right, [1]), rtol=1e-4
    )


def test_figures_of_expressions_are_of_skin_that_moves(model_file):
    """Linings, neck, chest and scalp would be up to two fifths of a region, and make its error small."""
    data = gnm_npz.read(model_file)
    moving = np.linalg.norm(data.expression_basis.astype(np.float64), axis=2).max(0) > 1e-5
    for region, (_, mask) in regions.expression_regions(data).items():
        part = linear_fit.expression_parts(data)[region]
        still = part.mask[~moving[part.part.rows]].sum() / part.mask.sum()
        print(f"{region}: {still:.3f} of the mask does not move, of the file's {mask[~moving].sum() / mask.sum():.3f}")
        assert still < 0.01
        assert regions.face(data)[part.part.rows].all()
