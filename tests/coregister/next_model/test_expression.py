"""Regional expression bases against dense computations and a jaw of which the motion is known."""

import numpy as np
import pytest
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from coregister.next_model import expression
from coregister.next_model.expression import ExpressionSettings, regional_bases
from coregister.region_masks import REGIONS, regional_masks
from registration.geometry.topology import vertex_areas
from registration.model import regions
from tests.coregister.next_model import known

ACTS = ("stretch", "smile", "jaw_open", "jaw_left", "wink_left", "wink_right", "brows_up", "pucker")


@pytest.fixture(scope="module")
def displacements(anatomy, model) -> list[np.ndarray]:
    people = known.people(anatomy, model, range(400, 405), ACTS)
    return [act.vertices - person.neutral.vertices for person in people for act in person.expressions]


@pytest.fixture(scope="module")
def weights(displacements) -> np.ndarray:
    return np.random.default_rng(0).uniform(0.5, 2, len(displacements))


@pytest.fixture(scope="module")
def bases(displacements, weights, model):
    return regional_bases(displacements, weights, model, ExpressionSettings(variance_ratio=0.999))


def test_masks_sum_to_one_on_the_skin_and_mirror(model):
    masks, skin = regional_masks(model), regions.skin(model)
    np.testing.assert_allclose(masks.sum(0)[skin], 1, atol=1e-12)
    assert not masks[:, ~skin].any() and masks.min() >= 0
    np.testing.assert_allclose(masks[1], masks[0][model.mirror_indices], atol=1e-12)
    assert (model.mirror_indices[model.mirror_indices] == np.arange(len(skin))).all()
    # The first model's groups are the masks that it was built with.
    names = ("expression_basis_left_eye", "expression_basis_right_eye", "expression_basis_mouth_nose_ears")
    own = np.stack([regions.group(model, name) for name in names])
    assert np.abs(own - masks)[:, skin].mean() < 0.005


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
    for name, mask, own, w in (
        ("lower_face_region", masks[2] + regions.lower_teeth(model), displacements, weights),
        ("left_eye_region", masks[0], displacements + mirrored, np.r_[weights, weights]),
    ):
        flat = np.stack([(d.astype(np.float64) * mask[:, None]).ravel() for d in own]) * np.sqrt(w / w.sum())[:, None]
        _, s, vt = np.linalg.svd(flat, full_matrices=False)
        found, skin = bases[name], np.repeat(regions.skin(model), 3)
        kept = len(found.energy)
        assert np.cumsum(s**2)[kept - 2] < 0.999 * (s**2).sum() <= np.cumsum(s**2)[kept - 1]
        np.testing.assert_allclose(found.energy, s[:kept] ** 2, rtol=1e-4)
        mine = found.basis.reshape(kept, -1) * skin
        truth = vt[:kept] * np.sign((vt[:kept] * mine).sum(1))[:, None] * s[:kept, None] * skin
        print(f"{name}: {np.abs(mine - truth).max() / s[0]:.1e}")
        assert np.abs(mine - truth).max() < 1e-4 * s[0]


def test_nothing_but_skin_and_what_the_jaw_takes_along_moves(bases, model):
    masks = regional_masks(model)
    for name, mask in zip(REGIONS, masks, strict=True):
        moving = (mask > 0) | (regions.jaw_parts(model) & (name == "lower_face_region"))
        assert not bases[name].basis[:, ~moving].any()
    still = (
        (regions.group(model, "upper_teeth_and_gums") > 0.5) | regions.eyeballs(model)[0] | regions.eyeballs(model)[1]
    )
    assert not any(region.basis[:, still].any() for region in bases.values())


def test_both_eyes_can_be_kept_apart(displacements, weights, bases, model):
    alone = regional_bases(displacements, weights, model, ExpressionSettings(variance_ratio=0.999, both_eyes=False))
    assert alone["left_eye_region"].energy[0] != pytest.approx(bases["left_eye_region"].energy[0], rel=1e-3)
    assert np.array_equal(alone["lower_face_region"].basis, bases["lower_face_region"].basis)


def test_the_previous_model_can_have_a_share(displacements, weights, bases, model):
    mixed = regional_bases(displacements, weights, model, ExpressionSettings(variance_ratio=0.999, shrinkage=0.3))
    for name in REGIONS:
        assert mixed[name].shrinkage == 0.3 and bases[name].shrinkage == 0
        total = mixed[name].energy.sum() / mixed[name].variance_ratio
        assert total == pytest.approx(bases[name].energy.sum() / bases[name].variance_ratio, rel=1e-4)
        assert len(mixed[name].energy) > len(bases[name].energy)


def test_components_by_area_are_orthogonal_there(displacements, weights, model):
    found = regional_bases(displacements, weights, model, ExpressionSettings(variance_ratio=0.999, by_area=True))[
        "left_eye_region"
    ]
    rows = regional_masks(model)[0] > 0
    area = vertex_areas(model.template_vertex_positions, model.triangles)[rows]
    weight = np.repeat(np.maximum(area, 0.01 * area.mean()) / area.mean(), 3)
    flat = found.basis[:, rows].reshape(len(found.basis), -1)
    np.testing.assert_allclose((flat * weight) @ flat.T, np.diag(found.energy), atol=1e-5 * found.energy[0])


def test_the_jaw_moves_rigidly_to_first_order(model):
    """A small turn of the lower teeth about an axis by the ears, with the skin around left alone."""
    points = model.template_vertex_positions.astype(np.float64)
    axis, angle = np.array([0.0, 0.27, 0.03]), 1e-4
    turned = Rotation.from_rotvec([angle, 0, 0]).apply(points - axis) + axis - points
    basis = (turned * regions.lower_teeth(model)[:, None])[None]
    parts = regions.jaw_parts(model)
    assert np.abs(expression.jaw_motion(basis, model)[0][parts] - turned[parts]).max() < 1e-3 * np.abs(turned).max()
    # Linear: twice the component moves the teeth twice as far.
    np.testing.assert_allclose(
        expression.jaw_motion(7 * basis, model), 7 * expression.jaw_motion(basis, model), atol=1e-15
    )


def test_an_opened_jaw_takes_the_lower_teeth_along(displacements, bases, anatomy, model):
    """MakeHuman's own jaw is the truth: its teeth's helper moves with it."""
    number = ACTS.index("jaw_open")
    skin, parts = regions.skin(model), regions.jaw_parts(model)
    flat = np.concatenate([r.basis[:, skin].reshape(len(r.basis), -1) for r in bases.values()])
    whole = np.concatenate([r.basis for r in bases.values()])
    target = displacements[number]
    c = np.linalg.lstsq(flat.T, target[skin].ravel().astype(np.float64), rcond=None)[0]
    away = np.tensordot(c, whole, 1)[parts] - target[parts]
    moved = np.linalg.norm(target[parts], axis=1).mean()
    print(f"lower teeth and tongue: {1e3 * moved:.2f} mm, off by {1e3 * np.linalg.norm(away, axis=1).mean():.2f} mm")
    assert moved > 5e-3 and np.linalg.norm(away, axis=1).mean() < 0.05 * moved


def test_coefficients_are_those_of_least_squares(displacements, weights, bases, model):
    found = expression.coefficient_statistics(displacements, weights, bases, model)
    skin = regions.skin(model)
    flat = np.concatenate([r.basis[:, skin].reshape(len(r.basis), -1) for r in bases.values()])
    rows = np.linalg.lstsq(flat.T, np.stack([d[skin].ravel() for d in displacements]).T.astype(float), rcond=None)[0].T
    mean = np.average(rows, axis=0, weights=weights)
    np.testing.assert_allclose(found.mean, mean, atol=1e-6)
    np.testing.assert_allclose(found.covariance, np.cov(rows.T, aweights=weights, ddof=0), atol=1e-6)
    assert len(found.names) == len(found.mean) and found.names[0] == "left_eye_region_000"
    # About zero their squares are one, but for what regions share along their borders.
    square = np.diag(found.covariance) + found.mean**2
    assert 0.5 < np.median(square) < 1.5
