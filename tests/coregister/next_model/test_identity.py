"""The identity basis against models of which the answer is known."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import subspace_angles

from coregister.next_model import eyelids
from coregister.next_model.alignment import align_neutrals
from coregister.next_model.identity import IdentityBasis, IdentitySettings, build_identity_basis
from coregister.region_masks import FLIP, mirrored
from registration.geometry.rigid import fit_twists, motion_fields
from registration.geometry.topology import vertex_areas
from registration.model import regions
from registration.model.gnm_npz import GNMData
from registration.stabilize.subject_meshes import SkullSkin
from tests.coregister.next_model import known

RAW = IdentitySettings(variance_ratio=1.0, shrinkage=0.0, by_area=False, mirrored=False, eyelids_follow=False)


def _aligned(model: GNMData, shapes: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    heads = known.moved(shapes, rng).astype(np.float32)
    names = [str(k) for k in range(len(heads))]
    return align_neutrals(heads, np.ones(heads.shape[:2], np.float32), names, model).vertices


def _drawn(model: GNMData, rng: np.random.Generator, count: int) -> np.ndarray:
    return known.heads(model, rng.normal(size=(count, len(known.head_components(model)))))


def _still(model: GNMData) -> np.ndarray:
    """The model's own components without the rigid motions of the stable skin: K V 3."""
    basis, stable = known.head_components(model), SkullSkin.of(model).area
    points = model.template_vertex_positions.astype(np.float64)
    points = points - stable @ points / stable.sum()
    return basis - np.tensordot(fit_twists(basis, points, stable), motion_fields(points), 1)


def _skin(basis: np.ndarray, model: GNMData) -> np.ndarray:
    return basis[:, regions.skin(model)].reshape(len(basis), -1)


def test_whitened_samples_give_the_model_back(model):
    """A model whose components hold no motion of the skull's skin: alignment then has nothing of theirs to remove."""
    rng = np.random.default_rng(0)
    basis = _still(model)
    size = len(basis)
    shapes = model.template_vertex_positions + np.tensordot(known.whitened(rng, 150, size), basis, 1)
    found = build_identity_basis(_aligned(model, shapes, rng), model, replace(RAW, max_components=size))
    mine, truth = _skin(found.basis, model), _skin(basis, model)
    values = np.linalg.svd(truth, compute_uv=False) ** 2
    angles = np.degrees(subspace_angles(mine.T, truth.T))
    print(f"angle {angles.max():.4f} deg, eigenvalues {np.abs(found.variance / values - 1).max():.1e}")
    np.testing.assert_allclose(found.variance, values, rtol=0.01)
    assert angles.max() < 0.1


def test_raw_draws_equal_a_dense_svd(model):
    rng = np.random.default_rng(1)
    heads = _aligned(model, _drawn(model, rng, 40), rng)
    found = build_identity_basis(heads, model, RAW)
    flat = heads[:, regions.skin(model)].astype(np.float64).reshape(len(heads), -1)
    mean = flat.mean(0)
    _, s, vt = np.linalg.svd(flat - mean, full_matrices=False)
    expected = (s**2 / (len(heads) - 1))[: len(heads) - 1]
    np.testing.assert_allclose(found.variance, expected, rtol=1e-4)
    skin = regions.skin(model)
    np.testing.assert_allclose(found.template[skin].ravel(), mean, atol=1e-7)
    mine = _skin(found.basis, model)
    aligned = vt[: len(mine)] * np.sign((mine * vt[: len(mine)]).sum(1))[:, None]
    away = np.abs(mine - aligned * np.sqrt(expected)[:, None]).max()
    print(f"components {away:.2e} m, variances {np.abs(found.variance / expected - 1).max():.2e}")
    assert away < 1e-4 * np.abs(mine).max()
    assert found.variance_ratio == pytest.approx(1, abs=1e-6)


def test_components_by_area_are_those_of_the_surface(model):
    """Orthogonal where every square millimetre counts alike, and with the variance that it has there."""
    rng = np.random.default_rng(7)
    heads = _aligned(model, _drawn(model, rng, 15), rng)
    found = build_identity_basis(heads, model, replace(RAW, by_area=True))
    skin = regions.skin(model)
    area = vertex_areas(model.template_vertex_positions, model.triangles)[skin]
    weight = np.repeat(np.maximum(area, 0.01 * area.mean()) / area.mean(), 3)
    mine = _skin(found.basis, model)
    gram = (mine * weight) @ mine.T
    np.testing.assert_allclose(gram, np.diag(found.variance), atol=1e-5 * found.variance[0])
    away = (heads[:, skin] - heads[:, skin].mean(0)).reshape(len(heads), -1).astype(np.float64)
    assert found.variance.sum() == pytest.approx((away**2 @ weight).sum() / (len(heads) - 1), rel=1e-5)
    np.testing.assert_allclose(away - away @ (weight * mine).T @ np.linalg.pinv(gram) @ mine, 0, atol=2e-6)


def test_a_share_or_a_number_truncates(model):
    rng = np.random.default_rng(2)
    heads = _aligned(model, _drawn(model, rng, 20), rng)
    for ratio in (0.9, 0.99):
        found = build_identity_basis(heads, model, replace(RAW, variance_ratio=ratio))
        fewer = found.variance[:-1].sum() / found.variance.sum() * found.variance_ratio
        assert fewer < ratio <= found.variance_ratio
    assert len(build_identity_basis(heads, model, replace(RAW, max_components=5)).basis) == 5


def test_the_previous_model_has_the_share_that_is_stated(model):
    rng = np.random.default_rng(3)
    heads = _aligned(model, _drawn(model, rng, 8), rng)
    alone = build_identity_basis(heads, model, RAW)
    mixed = build_identity_basis(heads, model, replace(RAW, shrinkage=0.2))
    assert (alone.shrinkage, mixed.shrinkage) == (0, 0.2)
    assert mixed.variance.sum() == pytest.approx(alone.variance.sum(), rel=1e-5)
    assert len(alone.basis) == 7 and len(mixed.basis) >= len(known.head_components(model))
    # In directions that the heads do not reach there is exactly what the previous model brings along.
    own, truth = _skin(alone.basis, model), _skin(_still(model), model)
    q, _ = np.linalg.qr(own.T)
    beyond = truth - (truth @ q) @ q.T
    both = _skin(mixed.basis, model)
    left = both - (both @ q) @ q.T
    scale = 0.2 * alone.variance.sum() / (truth**2).sum()
    assert (left**2).sum() == pytest.approx(scale * (beyond**2).sum(), rel=1e-3)


def test_parts_in_the_mouth_move_as_they_do_in_the_heads(model):
    """Of another head of the same people, its skin alone tells where teeth and tongue are."""
    rng = np.random.default_rng(4)
    heads = _aligned(model, _drawn(model, rng, 120), rng)
    found = build_identity_basis(heads[:-10], model, RAW)
    mouth = (regions.group(model, "upper_teeth_and_gums") > 0.5) | regions.jaw_parts(model)
    away = heads[-10:] - found.template
    coefficients = np.linalg.lstsq(_skin(found.basis, model).T, _skin(away, model).T, rcond=None)[0].T
    error = np.tensordot(coefficients, found.basis, 1)[:, mouth] - away[:, mouth]
    moved, off = (1e3 * np.linalg.norm(part, axis=2).mean() for part in (away[:, mouth], error))
    print(f"teeth and tongue of other heads: {moved:.2f} mm from the template, {off:.3f} mm off")
    assert moved > 1 and off < 0.02 * moved
    np.testing.assert_allclose(found.template[mouth], heads[:-10].mean(0)[mouth], atol=1e-6)


@pytest.fixture(scope="module")
def of_people(anatomy, model) -> tuple[GNMData, IdentityBasis, IdentityBasis]:
    """The model with the template of people that it does not span, their basis, and the same with lids left alone."""
    subjects = known.people(anatomy, model, range(300, 324), ("smile",))
    heads = np.stack([subject.neutral.vertices for subject in subjects])
    aligned = align_neutrals(heads, np.ones(heads.shape[:2], np.float32), [s.name for s in subjects], model)
    settings = IdentitySettings(variance_ratio=0.99, shrinkage=0.2, by_area=False)
    left, found = (
        build_identity_basis(aligned.vertices, model, replace(settings, eyelids_follow=r)) for r in (False, True)
    )
    return replace(model, template_vertex_positions=found.template.astype(np.float32)), found, left


def test_lids_stay_on_the_eyeballs(of_people, model):
    new, found, left = of_people
    both = eyelids.eyelid_rims(new)
    for before, after in zip(eyelids.eyelid_rims(model), both, strict=True):
        gap, _ = after.gaps(found.template[before.rim], np.zeros(3))
        print(f"template: gap change {1e3 * np.abs(gap - before.gap).mean():.3f} mm (mean over the rim)")
        assert np.abs(gap - before.gap).mean() < 0.2e-3
    change, alone = (eyelids.gap_change_mm(both, found.template, one.basis) for one in (found, left))
    print(f"worst component at 3 sigma: {change.max():.3f} mm; moved eyeballs alone {alone.max():.3f}")
    assert change.max() < 0.2 and change.max() < alone.max()
    # And the eyeballs do follow: left where they are, they would part from the lids.
    still = found.basis.copy()
    still[:, regions.eyeballs(new)[0] | regions.eyeballs(new)[1]] = 0
    assert eyelids.gap_change_mm(both, found.template, still).max() > 2 * change.max()


def test_an_eyeball_without_lids_has_no_gap_that_changes(of_people):
    new, found, _ = of_people
    bare = tuple(replace(rims, rim=np.zeros(0, int), gap=np.zeros(0)) for rims in eyelids.eyelid_rims(new))
    assert not eyelids.gap_change_mm(bare, found.template, found.basis[:2]).any()


def test_settling_lids_changes_nothing_else(of_people, model):
    _, found, left = of_people
    away = np.linalg.norm(found.basis - left.basis, axis=2).max(0)
    far = regions.exterior(model) & (regions.lids(model) == 0)
    assert away[far].max() * eyelids.BOUND < 0.05e-3 and away.max() > 0


def test_eyeballs_move_as_a_whole(of_people):
    new, found, _ = of_people
    for ball in regions.eyeballs(new):
        assert np.ptp(found.basis[:, ball], axis=1).max() == 0


MIRRORED = replace(RAW, mirrored=True)


def _lopsided(model: GNMData, rng: np.random.Generator, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Heads of the symmetric model with a bump of random height on the left cheek, and what it does: metres."""
    points = model.template_vertex_positions
    away = points - points[np.argmax(points[:, 2] + 0.5 * points[:, 0])]
    bump = np.exp(-(away**2).sum(1, keepdims=True) / 0.02**2) * (0.3, 0.1, 1.0) * 3e-3
    return _drawn(model, rng, count) + rng.normal(size=(count, 1, 1)) * bump, bump


def test_mirrored_heads_make_a_symmetric_model(model):
    """Template and what the basis spans are their own mirror images; so are left and right of each component."""
    rng = np.random.default_rng(8)
    heads = align_neutrals(
        known.moved(_lopsided(model, rng, 12)[0], rng).astype(np.float32),
        np.ones((12, len(model.mirror_indices)), np.float32),
        [str(k) for k in range(12)],
        model,
        mirrored=True,
    ).vertices
    for settings in (MIRRORED, IdentitySettings(variance_ratio=1.0, shrinkage=0.2)):
        found = build_identity_basis(heads, model, settings)
        assert (found.head_count, found.mirrored) == (12, True)
        template = found.template[model.mirror_indices] * FLIP
        twins = mirrored(found.basis, model.mirror_indices)
        flat, other = (basis.reshape(len(basis), -1) for basis in (found.basis, twins))
        left = other - other @ np.linalg.pinv(flat) @ flat
        print(f"template {np.abs(template - found.template).max():.1e} m, span {np.abs(left).max():.1e} m")
        assert np.abs(template - found.template).max() <= 1e-7 and np.abs(left).max() <= 1e-7
        same, opposite = (np.abs(twins - sign * found.basis).max((1, 2)) < 1e-7 for sign in (1, -1))
        assert (same ^ opposite).all() and opposite.sum() >= 1
    # By its nature no component of the heads alone is that.
    alone = build_identity_basis(heads, model, RAW)
    twins = mirrored(alone.basis, model.mirror_indices)
    assert min(np.abs(twins - sign * alone.basis).max((1, 2)).min() for sign in (1, -1)) > 1e-5


def test_mirrored_variance_keeps_its_meaning(model):
    """Symmetric parts have it about their mean, with N - 1; antisymmetric parts about zero, which is known, with N."""
    rng = np.random.default_rng(9)
    heads, bump = _lopsided(model, rng, 9)
    heads = heads.astype(np.float32)
    found = build_identity_basis(heads, model, MIRRORED)
    skin = regions.skin(model)
    twins = mirrored(heads, model.mirror_indices)
    even, odd = (((heads + sign * twins) / 2)[:, skin].reshape(9, -1).astype(np.float64) for sign in (1, -1))
    even = np.linalg.svd(even - even.mean(0), compute_uv=False) ** 2 / 8
    odd = np.linalg.svd(odd, compute_uv=False) ** 2 / 9
    expected = np.sort(np.concatenate([even[:8], odd[:1]]))[::-1]  # the bump's height is the one asymmetry there is
    np.testing.assert_allclose(found.variance[: len(expected)], expected, rtol=1e-4)
    assert found.variance[len(expected) :].sum() < 1e-6 * expected.sum()
    # And its direction is a component: half a bump here, less half a bump there.
    pair = ((bump - mirrored(bump[None], model.mirror_indices)[0]) / 2)[skin].ravel()
    own = _skin(found.basis, model)
    cosine = np.abs(own @ pair) / np.linalg.norm(own, axis=1) / np.linalg.norm(pair)
    assert cosine.max() > 1 - 1e-5


def test_mirror_images_of_a_symmetric_models_heads_change_nothing(model):
    """Whitened samples of a symmetric model give it back, mirrored or not."""
    rng = np.random.default_rng(10)
    basis = _still(model)[:12]
    shapes = model.template_vertex_positions + np.tensordot(known.whitened(rng, 40, 12), basis, 1)
    found = build_identity_basis(shapes.astype(np.float32), model, replace(MIRRORED, max_components=12))
    mine, truth = _skin(found.basis, model), _skin(basis, model)
    assert np.degrees(subspace_angles(mine.T, truth.T)).max() < 0.1
    np.testing.assert_allclose(found.variance, np.linalg.svd(truth, compute_uv=False) ** 2, rtol=0.01)
