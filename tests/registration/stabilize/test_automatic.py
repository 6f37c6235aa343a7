"""Known motions are recovered; unobserved vertices and skin that does not follow the skull have no weight."""

from dataclasses import replace

import numpy as np
import pytest

from bench.support import performances, stabilization_measures
from registration.errors import InputError
from registration.geometry.rigid import align
from registration.model.regions import group
from registration.stabilize.automatic import stabilize_subject
from registration.stabilize.subject_meshes import subject_meshes
from tests.fixtures.far_world import UTM
from tests.registration.report.test_page import a_registration


@pytest.fixture(scope="module")
def results(truths, observations, skin):
    return [
        stabilize_subject(performances.observed_meshes(t, s), skin) for t, s in zip(truths, observations, strict=True)
    ]


def test_motion_is_recovered_and_procrustes_is_worse(truths, observations, results, model):
    rows = list(zip(results, observations, truths, strict=True))
    deg, mm = np.concatenate(
        [stabilization_measures.remaining_motion(r.T_neutral_expression, s, t, model) for r, s, t in rows], 1
    )
    assert np.median(deg) < 0.1 and np.median(mm) < 0.2 and np.percentile(mm, 95) < 0.35
    procrustes = [
        stabilization_measures.remaining_motion(align(s.vertices, s.neutral, np.ones(s.confidence.shape)), s, t, model)
        for _, s, t in rows
    ]
    assert np.median(np.concatenate(procrustes, 1)[1]) > 3 * np.median(mm)


def test_without_noise_stable_skin_has_weight_and_residuals_fall(truths, skin, model):
    observed = performances.observe(truths[0], 0, smooth_mm=0, white_mm=0, unobserved=0)
    result = stabilize_subject(performances.observed_meshes(truths[0], observed), skin)
    confidence_map = result.confidence_map
    assert 0 <= confidence_map.min() and confidence_map.max() <= 1 and not confidence_map[skin.area == 0].any()
    ears, lids = group(model, "ears") > 0.5, group(model, "left_orbital_region") > 0.5
    assert (
        np.median(confidence_map[ears & (skin.area > 0)])
        > 0.98
        > np.percentile(confidence_map[lids & (skin.area > 0)], 20)
    )
    assert np.median(result.residual_mm[:, -1]) < 0.75 * np.median(result.residual_mm[:, 0])
    assert (
        stabilization_measures.remaining_motion(result.T_neutral_expression, observed, truths[0], model)[1].max() < 0.15
    )


def test_vertices_are_the_transformed_expressions(results, observations):
    for result, observed in zip(results, observations, strict=True):
        T = result.T_neutral_expression[3]
        np.testing.assert_allclose(result.vertices[3], observed.vertices[3] @ T[:3, :3].T + T[:3, 3], atol=1e-6)


def test_a_far_world_is_stabilized_as_a_near_one(truths, observations, skin, results, tmp_path):
    meshes = performances.observed_meshes(truths[0], observations[0])
    far = replace(meshes, neutral=meshes.neutral + UTM, vertices=meshes.vertices + UTM)
    result = stabilize_subject(far, skin)
    np.testing.assert_allclose(result.vertices - UTM, results[0].vertices, atol=1e-6)
    np.testing.assert_allclose(result.residual_mm, results[0].residual_mm, atol=1e-3)


def test_rotation_on_the_neck_is_recovered(truths, observations, skin, model):
    rotated = performances.with_still_body(observations[0], model)
    assert 1e3 * np.abs(rotated.vertices - observations[0].vertices).max() > 5
    result = stabilize_subject(performances.observed_meshes(truths[0], rotated), skin)
    assert (
        np.median(
            stabilization_measures.remaining_motion(result.T_neutral_expression, observations[0], truths[0], model)[1]
        )
        < 0.2
    )


def test_unobserved_vertices_have_no_weight(truths, observations, skin, results):
    observed = observations[0]
    changed = replace(
        observed,
        vertices=np.where(observed.confidence[..., None] > 0, observed.vertices, 9.0).astype(np.float32),
        neutral=np.where(observed.neutral_confidence[:, None] > 0, observed.neutral, -7.0).astype(np.float32),
    )
    result = stabilize_subject(performances.observed_meshes(truths[0], changed), skin)
    np.testing.assert_allclose(result.T_neutral_expression, results[0].T_neutral_expression, atol=1e-9)
    unobserved = observed.neutral_confidence == 0
    assert not result.confidence_map[unobserved].any()


def test_the_world_of_a_capture_does_not_matter(truths, observations, skin, results):
    """Another pose of every capture gives the same heads."""
    rng = np.random.default_rng(7)
    motions = np.stack([performances.random_motion(rng, 170.0, 4000.0, np.zeros(3)) for _ in truths[0].labels])
    result = stabilize_subject(
        performances.transformed(performances.observed_meshes(truths[0], observations[0]), motions), skin
    )
    np.testing.assert_allclose(result.vertices, results[0].vertices, atol=2e-5)


def test_a_single_expression_is_aligned(truths, observations, skin, model):
    jaw = truths[0].labels.index("jaw_open")
    meshes = performances.observed_meshes(truths[0], observations[0])
    meshes = replace(
        meshes, names=("a",), labels=("jaw_open",), vertices=meshes.vertices[[jaw]], confidence=meshes.confidence[[jaw]]
    )
    result = stabilize_subject(meshes, skin)
    remaining = result.T_neutral_expression @ observations[0].T_expression_neutral[[jaw]]
    deg, mm = stabilization_measures.motion_size(remaining, truths[0].neutral[stabilization_measures.face_mask(model)])
    assert deg < 0.3 and mm < 0.4


def registrations(observed, data, **changes):
    def registration(vertices, confidence):
        return a_registration(
            **{
                "vertices": vertices,
                "confidence": confidence,
                "offsets": np.zeros(vertices.shape, np.float32),
                "triangles": data.triangles.astype(np.int32),
                "corner_uvs": np.zeros((len(changes.get("triangles", data.triangles)), 3, 2), np.float32),
                **changes,
            }
        )

    return registration(observed.neutral, observed.neutral_confidence), [
        ("smile1", "smile", registration(observed.vertices[2], observed.confidence[2]))
    ]


def test_registrations_become_meshes(observations, skin, model):
    neutral, expressions = registrations(observations[0], model)
    meshes = subject_meshes("anna", neutral, iter(expressions), skin)
    assert meshes.names == ("smile1",) and meshes.labels == ("smile",)
    np.testing.assert_array_equal(meshes.vertices[0], observations[0].vertices[2])


@pytest.mark.parametrize(
    "changes, message",
    [
        ({"status": "failed", "reason": "blew up"}, "failed"),
        ({"triangles": np.array([[0, 1, 2]], np.int32)}, "another topology"),
        ({"confidence": np.zeros(21913, np.float32)}, "Hardly any skin"),
        ({"vertices": np.full((21913, 3), np.nan, np.float32)}, "not finite"),
    ],
)
def test_unusable_registrations_are_refused(observations, skin, model, changes, message):
    neutral, expressions = registrations(observations[0], model)
    _, unusable = registrations(observations[0], model, **changes)
    with pytest.raises(InputError, match=message) as caught:
        subject_meshes("anna", neutral, unusable, skin)
    assert "anna, smile1" in caught.value.where
    with pytest.raises(InputError, match="no expression"):
        subject_meshes("anna", neutral, [], skin)
