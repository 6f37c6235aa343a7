"""Regional expression bases against dense computations, and a jaw with known motion."""

import numpy as np
import pytest
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from coregister.next_model import expression
from coregister.next_model.expression import ExpressionSettings, regional_bases
from coregister.region_masks import REGIONS, regional_masks
from registration.geometry.topology import vertex_areas
from registration.model import regions
from tests.coregister.next_model import samples

EXPRESSIONS = ("stretch", "smile", "jaw_open", "jaw_left", "wink_left", "wink_right", "brows_up", "pucker")


@pytest.fixture(scope="module")
def displacements(head_assembly, model) -> list[np.ndarray]:
    subjects = samples.subjects(head_assembly, model, range(400, 405), EXPRESSIONS)
    return [mesh.vertices - subject.neutral.vertices for subject in subjects for mesh in subject.expressions]


@pytest.fixture(scope="module")
def weights(displacements) -> np.ndarray:
    return np.random.default_rng(0).uniform(0.5, 2, len(displacements))


@pytest.fixture(scope="module")
def bases(displacements, weights, model):
    return regional_bases(displacements, weights, model, ExpressionSettings(variance_ratio=0.999))


def test_masks_sum_to_one_on_the_face_and_mirror(model):
    masks, skin = regional_masks(model), regions.skin(model)
    linings = skin & ~regions.exterior(model)
    np.testing.assert_allclose(masks.sum(0)[regions.face(model) | linings], 1, atol=1e-12)
    assert not masks[:, ~skin].any() and masks.min() >= 0
    np.testing.assert_allclose(masks[1], masks[0][model.mirror_indices], atol=1e-12)
    assert (model.mirror_indices[model.mirror_indices] == np.arange(len(skin))).all()
    # The first model was built with its groups as masks.
    names = ("expression_basis_left_eye", "expression_basis_right_eye", "expression_basis_mouth_nose_ears")
    groups = np.stack([regions.group(model, name) for name in names])
    assert np.abs(groups - masks)[:, regions.face(model)].mean() < 0.005


def test_masks_end_where_expressions_do(displacements, model):
    """Neck, chest and scalp are in no mask, and hardly any motion is lost with them."""
    lost = regions.exterior(model) * (1 - regional_masks(model).sum(0))
    size = np.mean([np.linalg.norm(d, axis=1) for d in displacements], 0)
    energy = np.mean([(d**2).sum(1) for d in displacements], 0)
    print(f"energy {energy @ lost**2 / energy.sum():.1e}, up to {1e3 * (size * lost).max():.2f} mm")
    assert energy @ lost**2 < 1e-3 * energy.sum()
    chest = regions.neck_other(model) & (model.template_vertex_positions[:, 1] < 0.14)
    assert not regional_masks(model)[:, chest].any()


def test_masks_blend_over_about_ten_millimetres(model):
    lower, points, outside = regional_masks(model)[2], model.template_vertex_positions, regions.exterior(model)
    eyes, face = points[outside & (lower < 1e-3)], points[outside & (lower > 1 - 1e-3)]
    distance = 1e3 * cKDTree(face).query(eyes)[0]
    assert 6 < np.quantile(distance, 0.02) < 12


def test_the_right_eye_mirrors_the_left(bases, model):
    left, right = (bases[name].basis for name in ("left_eye_region", "right_eye_region"))
    assert np.abs(right - left[:, model.mirror_indices] * (-1, 1, 1)).max() <= 1e-7


def test_a_region_equals_a_dense_uncentred_svd(displacements, weights, bases, model):
    masks, mirror = regional_masks(model), model.mirror_indices
    mirrored = [d[mirror] * (-1, 1, 1) for d in displacements]
    for name, mask, region_samples, w in (
        ("lower_face_region", masks[2] + regions.lower_teeth(model), displacements, weights),
        ("left_eye_region", masks[0], displacements + mirrored, np.r_[weights, weights]),
    ):
        flat = (
            np.stack([(d.astype(np.float64) * mask[:, None]).ravel() for d in region_samples])
            * np.sqrt(w / w.sum())[:, None]
        )
        _, s, vt = np.linalg.svd(flat, full_matrices=False)
        region, skin = bases[name], np.repeat(regions.skin(model), 3)
        kept = len(region.energy)
        assert np.cumsum(s**2)[kept - 2] < 0.999 * (s**2).sum() <= np.cumsum(s**2)[kept - 1]
        np.testing.assert_allclose(region.energy, s[:kept] ** 2, rtol=1e-4)
        components = region.basis.reshape(kept, -1) * skin
        truth = vt[:kept] * np.sign((vt[:kept] * components).sum(1))[:, None] * s[:kept, None] * skin
        print(f"{name}: {np.abs(components - truth).max() / s[0]:.1e}")
        assert np.abs(components - truth).max() < 1e-4 * s[0]


def test_only_skin_and_parts_of_the_jaw_move(bases, model):
    masks = regional_masks(model)
    for name, mask in zip(REGIONS, masks, strict=True):
        moving = (mask > 0) | (regions.jaw_parts(model) & (name == "lower_face_region"))
        assert not bases[name].basis[:, ~moving].any()
    fixed = (
        (regions.group(model, "upper_teeth_and_gums") > 0.5) | regions.eyeballs(model)[0] | regions.eyeballs(model)[1]
    )
    assert not any(region.basis[:, fixed].any() for region in bases.values())


def test_samples_of_both_eyes_can_be_kept_apart(displacements, weights, bases, model):
    alone = regional_bases(displacements, weights, model, ExpressionSettings(variance_ratio=0.999, both_eyes=False))
    assert alone["left_eye_region"].energy[0] != pytest.approx(bases["left_eye_region"].energy[0], rel=1e-3)
    assert np.array_equal(alone["lower_face_region"].basis, bases["lower_face_region"].basis)


def test_shrinkage_adds_the_previous_model_and_keeps_the_energy(displacements, weights, bases, model):
    shrunk = regional_bases(displacements, weights, model, ExpressionSettings(variance_ratio=0.999, shrinkage=0.3))
    for name in REGIONS:
        assert shrunk[name].shrinkage == 0.3 and bases[name].shrinkage == 0
        total = shrunk[name].energy.sum() / shrunk[name].variance_ratio
        assert total == pytest.approx(bases[name].energy.sum() / bases[name].variance_ratio, rel=1e-4)
        assert len(shrunk[name].energy) > len(bases[name].energy)


def test_components_by_area_are_orthogonal_there(displacements, weights, model):
    settings = ExpressionSettings(variance_ratio=0.999, by_area=True)
    region = regional_bases(displacements, weights, model, settings)["left_eye_region"]
    rows = regional_masks(model)[0] > 0
    area = vertex_areas(model.template_vertex_positions, model.triangles)[rows]
    weight = np.repeat(np.maximum(area, 0.01 * area.mean()) / area.mean(), 3)
    flat = region.basis[:, rows].reshape(len(region.basis), -1)
    np.testing.assert_allclose((flat * weight) @ flat.T, np.diag(region.energy), atol=1e-5 * region.energy[0])


def test_the_jaw_moves_rigidly_to_first_order(model):
    """A small rotation of the lower teeth about an axis near the ears; the skin does not move."""
    points = model.template_vertex_positions.astype(np.float64)
    axis, angle = np.array([0.0, 0.27, 0.03]), 1e-4
    rotated = Rotation.from_rotvec([angle, 0, 0]).apply(points - axis) + axis - points
    basis = (rotated * regions.lower_teeth(model)[:, None])[None]
    parts = regions.jaw_parts(model)
    assert np.abs(expression.jaw_motion(basis, model)[0][parts] - rotated[parts]).max() < 1e-3 * np.abs(rotated).max()
    # Linear in the coefficient.
    np.testing.assert_allclose(
        expression.jaw_motion(7 * basis, model), 7 * expression.jaw_motion(basis, model), atol=1e-15
    )


def test_an_open_jaw_moves_the_lower_teeth(displacements, bases, head_assembly, model):
    """Ground truth: the motion of MakeHuman's teeth."""
    number = EXPRESSIONS.index("jaw_open")
    skin, parts = regions.skin(model), regions.jaw_parts(model)
    flat = np.concatenate([r.basis[:, skin].reshape(len(r.basis), -1) for r in bases.values()])
    whole = np.concatenate([r.basis for r in bases.values()])
    target = displacements[number]
    c = np.linalg.lstsq(flat.T, target[skin].ravel().astype(np.float64), rcond=None)[0]
    error = np.tensordot(c, whole, 1)[parts] - target[parts]
    motion = np.linalg.norm(target[parts], axis=1).mean()
    print(f"lower teeth and tongue: {1e3 * motion:.2f} mm, error {1e3 * np.linalg.norm(error, axis=1).mean():.2f} mm")
    assert motion > 5e-3 and np.linalg.norm(error, axis=1).mean() < 0.05 * motion


def test_statistics_are_those_of_least_squares_coefficients(displacements, weights, bases, model):
    statistics = expression.coefficient_statistics(displacements, weights, bases, model)
    skin = regions.skin(model)
    flat = np.concatenate([r.basis[:, skin].reshape(len(r.basis), -1) for r in bases.values()])
    rows = np.linalg.lstsq(flat.T, np.stack([d[skin].ravel() for d in displacements]).T.astype(float), rcond=None)[0].T
    mean = np.average(rows, axis=0, weights=weights)
    np.testing.assert_allclose(statistics.mean, mean, atol=1e-6)
    np.testing.assert_allclose(statistics.covariance, np.cov(rows.T, aweights=weights, ddof=0), atol=1e-6)
    assert len(statistics.names) == len(statistics.mean) and statistics.names[0] == "left_eye_region_000"
    # Mean squares are about one; overlaps of regions at their borders change them.
    square = np.diag(statistics.covariance) + statistics.mean**2
    assert 0.5 < np.median(square) < 1.5
