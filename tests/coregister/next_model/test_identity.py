"""The identity basis against models with known statistics."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.linalg import subspace_angles

from coregister.next_model import eyelids
from coregister.next_model.alignment import align_neutrals
from coregister.next_model.identity import IdentityBasis, IdentitySettings, VertexMetric, build_identity_basis
from coregister.region_masks import FLIP, mirrored
from registration.errors import InputError
from registration.geometry.rigid import fit_twists, motion_fields
from registration.geometry.topology import vertex_areas, vertex_normals
from registration.model import regions
from registration.model.gnm_npz import GNMData
from registration.stabilize.subject_meshes import SkullSkin
from tests.coregister.next_model import samples

RAW = IdentitySettings(variance_ratio=1.0, shrinkage=0.0, by_area=False, mirrored=False, eyelids_follow=False)


def _aligned(model: GNMData, shapes: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    heads = samples.transformed(shapes, rng).astype(np.float32)
    names = [str(k) for k in range(len(heads))]
    return align_neutrals(heads, np.ones(heads.shape[:2], np.float32), names, model).vertices


def _random_heads(model: GNMData, rng: np.random.Generator, count: int) -> np.ndarray:
    return samples.heads(model, rng.normal(size=(count, len(samples.head_components(model)))))


def _without_rigid_motion(model: GNMData) -> np.ndarray:
    """The model's own_components components without the rigid motions of the stable skin: K V 3."""
    basis, stable = samples.head_components(model), SkullSkin.from_model(model).area
    points = model.template_vertex_positions.astype(np.float64)
    points = points - stable @ points / stable.sum()
    return basis - np.tensordot(fit_twists(basis, points, stable), motion_fields(points), 1)


def _skin(basis: np.ndarray, model: GNMData) -> np.ndarray:
    return basis[:, regions.skin(model)].reshape(len(basis), -1)


def test_whitened_samples_reproduce_the_model(model):
    """Of a model whose components contain no motion of the stable skin, which alignment would remove."""
    rng = np.random.default_rng(0)
    basis = _without_rigid_motion(model)
    size = len(basis)
    shapes = model.template_vertex_positions + np.tensordot(samples.whitened(rng, 150, size), basis, 1)
    result = build_identity_basis(_aligned(model, shapes, rng), model, replace(RAW, max_components=size))
    components, expected_components = _skin(result.basis, model), _skin(basis, model)
    values = np.linalg.svd(expected_components, compute_uv=False) ** 2
    angles = np.degrees(subspace_angles(components.T, expected_components.T))
    print(f"angle {angles.max():.4f} deg, eigenvalues {np.abs(result.variance / values - 1).max():.1e}")
    np.testing.assert_allclose(result.variance, values, rtol=0.01)
    assert angles.max() < 0.1


def test_random_samples_equal_a_dense_svd(model):
    rng = np.random.default_rng(1)
    heads = _aligned(model, _random_heads(model, rng, 40), rng)
    result = build_identity_basis(heads, model, RAW)
    flat = heads[:, regions.skin(model)].astype(np.float64).reshape(len(heads), -1)
    mean = flat.mean(0)
    _, s, vt = np.linalg.svd(flat - mean, full_matrices=False)
    expected = (s**2 / (len(heads) - 1))[: len(heads) - 1]
    np.testing.assert_allclose(result.variance, expected, rtol=1e-4)
    skin = regions.skin(model)
    np.testing.assert_allclose(result.template[skin].ravel(), mean, atol=1e-7)
    components = _skin(result.basis, model)
    aligned = vt[: len(components)] * np.sign((components * vt[: len(components)]).sum(1))[:, None]
    difference = np.abs(components - aligned * np.sqrt(expected)[:, None]).max()
    print(f"components {difference:.2e} m, variances {np.abs(result.variance / expected - 1).max():.2e}")
    assert difference < 1e-4 * np.abs(components).max()
    assert result.variance_ratio == pytest.approx(1, abs=1e-6)


def test_components_by_area_are_orthogonal_over_the_surface(model):
    """Products and variances with vertices weighted by area."""
    rng = np.random.default_rng(7)
    heads = _aligned(model, _random_heads(model, rng, 15), rng)
    result = build_identity_basis(heads, model, replace(RAW, by_area=True))
    skin = regions.skin(model)
    area = vertex_areas(model.template_vertex_positions, model.triangles)[skin]
    weight = np.repeat(np.maximum(area, 0.01 * area.mean()) / area.mean(), 3)
    components = _skin(result.basis, model)
    gram = (components * weight) @ components.T
    np.testing.assert_allclose(gram, np.diag(result.variance), atol=1e-5 * result.variance[0])
    difference = (heads[:, skin] - heads[:, skin].mean(0)).reshape(len(heads), -1).astype(np.float64)
    assert result.variance.sum() == pytest.approx((difference**2 @ weight).sum() / (len(heads) - 1), rel=1e-5)
    np.testing.assert_allclose(
        difference - difference @ (weight * components).T @ np.linalg.pinv(gram) @ components, 0, atol=2e-6
    )


def test_variance_ratio_and_maximum_truncate(model):
    rng = np.random.default_rng(2)
    heads = _aligned(model, _random_heads(model, rng, 20), rng)
    for ratio in (0.9, 0.99):
        result = build_identity_basis(heads, model, replace(RAW, variance_ratio=ratio))
        fewer = result.variance[:-1].sum() / result.variance.sum() * result.variance_ratio
        assert fewer < ratio <= result.variance_ratio
    assert len(build_identity_basis(heads, model, replace(RAW, max_components=5)).basis) == 5


def test_shrinkage_is_the_fraction_of_variance_from_the_previous_model(model):
    rng = np.random.default_rng(3)
    heads = _aligned(model, _random_heads(model, rng, 8), rng)
    alone = build_identity_basis(heads, model, RAW)
    shrunk = build_identity_basis(heads, model, replace(RAW, shrinkage=0.2))
    assert (alone.shrinkage, shrunk.shrinkage) == (0, 0.2)
    assert shrunk.variance.sum() == pytest.approx(alone.variance.sum(), rel=1e-5)
    assert len(alone.basis) == 7 and len(shrunk.basis) >= len(samples.head_components(model))
    # Orthogonal to the heads there is exactly the variance of the previous model.
    own_components, expected_components = _skin(alone.basis, model), _skin(_without_rigid_motion(model), model)
    q, _ = np.linalg.qr(own_components.T)
    beyond = expected_components - (expected_components @ q) @ q.T
    both = _skin(shrunk.basis, model)
    left = both - (both @ q) @ q.T
    scale = 0.2 * alone.variance.sum() / (expected_components**2).sum()
    assert (left**2).sum() == pytest.approx(scale * (beyond**2).sum(), rel=1e-3)


def test_teeth_and_tongue_follow_the_skin_as_in_the_heads(model):
    """Coefficients from the skin of further heads predict their teeth and tongue."""
    rng = np.random.default_rng(4)
    heads = _aligned(model, _random_heads(model, rng, 120), rng)
    result = build_identity_basis(heads[:-10], model, RAW)
    mouth = (regions.group(model, "upper_teeth_and_gums") > 0.5) | regions.jaw_parts(model)
    difference = heads[-10:] - result.template
    coefficients = np.linalg.lstsq(_skin(result.basis, model).T, _skin(difference, model).T, rcond=None)[0].T
    error = np.tensordot(coefficients, result.basis, 1)[:, mouth] - difference[:, mouth]
    distance_mm, error_mm = (1e3 * np.linalg.norm(part, axis=2).mean() for part in (difference[:, mouth], error))
    print(f"teeth and tongue of other heads: {distance_mm:.2f} mm from the template, {error_mm:.3f} mm off")
    assert distance_mm > 1 and error_mm < 0.02 * distance_mm
    np.testing.assert_allclose(result.template[mouth], heads[:-10].mean(0)[mouth], atol=1e-6)


@pytest.fixture(scope="module")
def subjects_basis(head_assembly, model) -> tuple[GNMData, IdentityBasis, IdentityBasis]:
    """The model with the template of subjects outside its span, their basis, and a basis without lid correction."""
    subjects = samples.subjects(head_assembly, model, range(300, 324), ("smile",))
    heads = np.stack([subject.neutral.vertices for subject in subjects])
    aligned = align_neutrals(heads, np.ones(heads.shape[:2], np.float32), [s.name for s in subjects], model)
    settings = IdentitySettings(variance_ratio=0.99, shrinkage=0.2, by_area=False)
    left, result = (
        build_identity_basis(aligned.vertices, model, replace(settings, eyelids_follow=r)) for r in (False, True)
    )
    return replace(model, template_vertex_positions=result.template.astype(np.float32)), result, left


def test_eyelids_stay_on_the_eyeballs(subjects_basis, model):
    new, result, left = subjects_basis
    both = eyelids.eyelid_rims(new)
    for before, after in zip(eyelids.eyelid_rims(model), both, strict=True):
        gap, _ = after.gaps(result.template[before.rim], np.zeros(3))
        print(f"template: gap change {1e3 * np.abs(gap - before.gap).mean():.3f} mm (mean over the rim)")
        assert np.abs(gap - before.gap).mean() < 0.2e-3
    change, alone = (eyelids.gap_change_mm(both, result.template, part.basis) for part in (result, left))
    print(f"worst component at 3 sigma: {change.max():.3f} mm; without correction of the lids {alone.max():.3f}")
    assert change.max() < 0.2 and change.max() < alone.max()
    # The eyeballs follow the lids: fixed ones would separate from them.
    fixed = result.basis.copy()
    fixed[:, regions.eyeballs(new)[0] | regions.eyeballs(new)[1]] = 0
    assert eyelids.gap_change_mm(both, result.template, fixed).max() > 2 * change.max()


def test_an_eyeball_without_rim_has_no_gap_change(subjects_basis):
    new, result, _ = subjects_basis
    bare = tuple(replace(rims, rim=np.zeros(0, int), gap=np.zeros(0)) for rims in eyelids.eyelid_rims(new))
    assert not eyelids.gap_change_mm(bare, result.template, result.basis[:2]).any()


def test_the_correction_of_the_lids_is_local(subjects_basis, model):
    _, result, left = subjects_basis
    difference = np.linalg.norm(result.basis - left.basis, axis=2).max(0)
    far = regions.exterior(model) & (regions.lids(model) == 0)
    assert difference[far].max() * eyelids.BOUND < 0.05e-3 and difference.max() > 0


def test_eyeballs_are_translated_rigidly(subjects_basis):
    new, result, _ = subjects_basis
    for ball in regions.eyeballs(new):
        assert np.ptp(result.basis[:, ball], axis=1).max() == 0


MIRRORED = replace(RAW, mirrored=True)


def _asymmetric(model: GNMData, rng: np.random.Generator, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Heads of the symmetric model with a bump of random height on the left cheek, and the bump, metres."""
    points = model.template_vertex_positions
    difference = points - points[np.argmax(points[:, 2] + 0.5 * points[:, 0])]
    bump = np.exp(-(difference**2).sum(1, keepdims=True) / 0.02**2) * (0.3, 0.1, 1.0) * 3e-3
    return _random_heads(model, rng, count) + rng.normal(size=(count, 1, 1)) * bump, bump


@pytest.mark.slow
def test_mirror_images_make_a_symmetric_model(model):
    """Template and span equal their mirror images; every component is symmetric or antisymmetric."""
    rng = np.random.default_rng(8)
    heads = align_neutrals(
        samples.transformed(_asymmetric(model, rng, 12)[0], rng).astype(np.float32),
        np.ones((12, len(model.mirror_indices)), np.float32),
        [str(k) for k in range(12)],
        model,
        mirrored=True,
    ).vertices
    for settings in (MIRRORED, IdentitySettings(variance_ratio=1.0, shrinkage=0.2)):
        result = build_identity_basis(heads, model, settings)
        assert (result.head_count, result.mirrored) == (12, True)
        template = result.template[model.mirror_indices] * FLIP
        mirror_images = mirrored(result.basis, model.mirror_indices)
        flat, other = (basis.reshape(len(basis), -1) for basis in (result.basis, mirror_images))
        left = other - other @ np.linalg.pinv(flat) @ flat
        print(f"template {np.abs(template - result.template).max():.1e} m, span {np.abs(left).max():.1e} m")
        assert np.abs(template - result.template).max() <= 1e-7 and np.abs(left).max() <= 1e-7
        same, opposite = (np.abs(mirror_images - sign * result.basis).max((1, 2)) < 1e-7 for sign in (1, -1))
        assert (same ^ opposite).all() and opposite.sum() >= 1
    # Components from the heads without mirror images are neither.
    alone = build_identity_basis(heads, model, RAW)
    mirror_images = mirrored(alone.basis, model.mirror_indices)
    assert min(np.abs(mirror_images - sign * alone.basis).max((1, 2)).min() for sign in (1, -1)) > 1e-5


def test_variance_of_symmetric_and_antisymmetric_parts(model):
    """Of symmetric parts about their mean, with N - 1; of antisymmetric parts about zero, with N."""
    rng = np.random.default_rng(9)
    heads, bump = _asymmetric(model, rng, 9)
    heads = heads.astype(np.float32)
    result = build_identity_basis(heads, model, MIRRORED)
    skin = regions.skin(model)
    mirror_images = mirrored(heads, model.mirror_indices)
    even, odd = (((heads + sign * mirror_images) / 2)[:, skin].reshape(9, -1).astype(np.float64) for sign in (1, -1))
    even = np.linalg.svd(even - even.mean(0), compute_uv=False) ** 2 / 8
    odd = np.linalg.svd(odd, compute_uv=False) ** 2 / 9
    expected = np.sort(np.concatenate([even[:8], odd[:1]]))[::-1]  # the only asymmetry is the bump
    np.testing.assert_allclose(result.variance[: len(expected)], expected, rtol=1e-4)
    assert result.variance[len(expected) :].sum() < 1e-6 * expected.sum()
    # The antisymmetric part of the bump is a component.
    pair = ((bump - mirrored(bump[None], model.mirror_indices)[0]) / 2)[skin].ravel()
    own_components = _skin(result.basis, model)
    cosine = np.abs(own_components @ pair) / np.linalg.norm(own_components, axis=1) / np.linalg.norm(pair)
    assert cosine.max() > 1 - 1e-5


def test_mirror_images_of_a_symmetric_models_heads_have_no_effect(model):
    """Whitened samples of a symmetric model reproduce it, mirrored or not."""
    rng = np.random.default_rng(10)
    basis = _without_rigid_motion(model)[:12]
    shapes = model.template_vertex_positions + np.tensordot(samples.whitened(rng, 40, 12), basis, 1)
    result = build_identity_basis(shapes.astype(np.float32), model, replace(MIRRORED, max_components=12))
    components, expected_components = _skin(result.basis, model), _skin(basis, model)
    assert np.degrees(subspace_angles(components.T, expected_components.T)).max() < 0.1
    np.testing.assert_allclose(result.variance, np.linalg.svd(expected_components, compute_uv=False) ** 2, rtol=0.01)


def test_displacements_along_the_skin_may_count_less(model):
    """A mode along the skin is larger than one across it, and first or second by the metric."""
    rng = np.random.default_rng(9)
    exterior, points = regions.exterior(model), model.template_vertex_positions.astype(np.float64)
    normals = vertex_normals(torch.from_numpy(points), torch.from_numpy(model.triangles.astype(np.int64))).numpy()
    wave = np.cos(points[:, 1:2] / 0.03) * exterior[:, None]
    across, along = 1e-3 * wave * normals, 2e-3 * wave * np.cross(normals, (0.0, 1.0, 0.0))
    coefficients = samples.whitened(rng, 12, 2)
    heads = (points + np.tensordot(coefficients, np.stack([across, along]), 1)).astype(np.float32)
    firsts = {}
    for weight in (1.0, 0.2):
        settings = IdentitySettings(
            shrinkage=0.0, max_components=2, along_skin=weight, mirrored=False, by_area=False, eyelids_follow=False
        )
        head = build_identity_basis(heads, model, settings)
        normal_part = (head.basis * normals).sum(-1)[:, exterior]
        firsts[weight] = (normal_part**2).sum(1)[0] / (head.basis[0, exterior] ** 2).sum()
        # Whatever the metric, two components represent both modes.
        flat = head.basis[:, exterior].reshape(2, -1).T
        for mode in (across, along):
            target = mode[exterior].ravel()
            rest = target - flat @ np.linalg.lstsq(flat, target, rcond=None)[0]
            assert np.linalg.norm(rest) < 1e-3 * np.linalg.norm(target)
    assert firsts[1.0] < 0.1 and firsts[0.2] > 0.9
    for weight in (0.0, 1.5):
        with pytest.raises(InputError, match="along the skin"):
            IdentitySettings(along_skin=weight)


def test_parts_stay_orthogonal_with_a_metric_along_the_skin(model):
    """Symmetric and antisymmetric parts, whose products are not computed."""
    rng = np.random.default_rng(10)
    heads = samples.heads(model, rng.normal(size=(5, len(samples.head_components(model)))))
    heads[:, :, 0] += 0.02 * np.maximum(heads[:, :, 0], 0) * rng.normal(size=(5, 1))
    settings = IdentitySettings(shrinkage=0.0, along_skin=0.3, variance_ratio=1.0, eyelids_follow=False)
    rows = np.flatnonzero(~np.any(regions.eyeballs(model), axis=0))
    head = build_identity_basis(heads.astype(np.float32), model, settings)
    scaled = VertexMetric.of_template(model, settings, rows).scaled(head.basis[:, rows]).reshape(len(head.basis), -1)
    products = scaled @ scaled.T
    np.testing.assert_allclose(products, np.diag(head.variance), atol=1e-4 * head.variance[0])
