"""Known motions come back; what is not seen, or not skin on the skull, has no say."""

from dataclasses import replace

import numpy as np
import pytest

from bench.support import performances, stabilization_measures
from registration.errors import InputError
from registration.geometry.rigid import align
from registration.model.regions import group
from registration.stabilize.automatic import stabilize_subject
from registration.stabilize.subject_meshes import subject_meshes
from tests.registration.report.test_page import a_registration


@pytest.fixture(scope="module")
def results(truths, seens, skin):
    return [stabilize_subject(performances.observed_meshes(t, s), skin) for t, s in zip(truths, seens, strict=True)]


def test_the_motion_is_found_and_procrustes_is_worse(truths, seens, results, model):
    rows = list(zip(results, seens, truths, strict=True))
    deg, mm = np.concatenate(
        [stabilization_measures.remaining_motion(r.T_neutral_expression, s, t, model) for r, s, t in rows], 1
    )
    assert np.median(deg) < 0.1 and np.median(mm) < 0.2 and np.percentile(mm, 95) < 0.35
    plain = [
        stabilization_measures.remaining_motion(align(s.vertices, s.neutral, np.ones(s.confidence.shape)), s, t, model)
        for _, s, t in rows
    ]
    assert np.median(np.concatenate(plain, 1)[1]) > 3 * np.median(mm)


def test_without_noise_the_map_trusts_what_stays_and_residuals_fall(truths, skin, model):
    seen = performances.observe(truths[0], 0, smooth_mm=0, white_mm=0, unobserved=0)
    result = stabilize_subject(performances.observed_meshes(truths[0], seen), skin)
    trust = result.confidence_map
    assert 0 <= trust.min() and trust.max() <= 1 and not trust[skin.area == 0].any()
    ears, lids = group(model, "ears") > 0.5, group(model, "left_orbital_region") > 0.5
    assert np.median(trust[ears & (skin.area > 0)]) > 0.98 > np.percentile(trust[lids & (skin.area > 0)], 20)
    assert np.median(result.residual_mm[:, -1]) < 0.75 * np.median(result.residual_mm[:, 0])
    assert stabilization_measures.remaining_motion(result.T_neutral_expression, seen, truths[0], model)[1].max() < 0.15


def test_vertices_are_what_the_motion_makes(results, seens):
    for result, seen in zip(results, seens, strict=True):
        T = result.T_neutral_expression[3]
        np.testing.assert_allclose(result.vertices[3], seen.vertices[3] @ T[:3, :3].T + T[:3, 3], atol=1e-6)


def test_heads_that_turn_on_their_necks_are_found_as_well(truths, seens, skin, model):
    turned = performances.with_still_body(seens[0], model)
    assert 1e3 * np.abs(turned.vertices - seens[0].vertices).max() > 5
    result = stabilize_subject(performances.observed_meshes(truths[0], turned), skin)
    assert (
        np.median(stabilization_measures.remaining_motion(result.T_neutral_expression, seens[0], truths[0], model)[1])
        < 0.2
    )


def test_unseen_vertices_have_no_say(truths, seens, skin, results):
    seen = seens[0]
    changed = replace(
        seen,
        vertices=np.where(seen.confidence[..., None] > 0, seen.vertices, 9.0).astype(np.float32),
        neutral=np.where(seen.neutral_confidence[:, None] > 0, seen.neutral, -7.0).astype(np.float32),
    )
    again = stabilize_subject(performances.observed_meshes(truths[0], changed), skin)
    np.testing.assert_allclose(again.T_neutral_expression, results[0].T_neutral_expression, atol=1e-9)
    unseen_at_rest = seen.neutral_confidence == 0
    assert not again.confidence_map[unseen_at_rest].any()


def test_the_world_of_a_capture_does_not_matter(truths, seens, skin, results):
    """Another place and turn for every capture: the same heads come out."""
    rng = np.random.default_rng(7)
    motions = np.stack([performances.random_motion(rng, 170.0, 4000.0, np.zeros(3)) for _ in truths[0].labels])
    found = stabilize_subject(
        performances.transformed(performances.observed_meshes(truths[0], seens[0]), motions), skin
    )
    np.testing.assert_allclose(found.vertices, results[0].vertices, atol=2e-5)


def test_one_expression_is_aligned_too(truths, seens, skin, model):
    jaw = truths[0].labels.index("jaw_open")
    one = performances.observed_meshes(truths[0], seens[0])
    one = replace(
        one, names=("a",), labels=("jaw_open",), vertices=one.vertices[[jaw]], confidence=one.confidence[[jaw]]
    )
    result = stabilize_subject(one, skin)
    left = result.T_neutral_expression @ seens[0].T_expression_neutral[[jaw]]
    deg, mm = stabilization_measures.motion_size(left, truths[0].neutral[stabilization_measures.face_mask(model)])
    assert deg < 0.3 and mm < 0.4


def registrations(seen, data, **changes):
    def one(vertices, confidence):
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

    return one(seen.neutral, seen.neutral_confidence), [("smile1", "smile", one(seen.vertices[2], seen.confidence[2]))]


def test_registrations_become_meshes(seens, skin, model):
    neutral, expressions = registrations(seens[0], model)
    meshes = subject_meshes("anna", neutral, iter(expressions), skin)
    assert meshes.names == ("smile1",) and meshes.labels == ("smile",)
    np.testing.assert_array_equal(meshes.vertices[0], seens[0].vertices[2])


@pytest.mark.parametrize(
    "changes, what",
    [
        ({"status": "failed", "reason": "blew up"}, "failed"),
        ({"triangles": np.array([[0, 1, 2]], np.int32)}, "another topology"),
        ({"confidence": np.zeros(21913, np.float32)}, "Hardly any skin"),
        ({"vertices": np.full((21913, 3), np.nan, np.float32)}, "not finite"),
    ],
)
def test_registrations_that_are_no_use_are_refused(seens, skin, model, changes, what):
    neutral, expressions = registrations(seens[0], model)
    _, bad = registrations(seens[0], model, **changes)
    with pytest.raises(InputError, match=what) as caught:
        subject_meshes("anna", neutral, bad, skin)
    assert "anna, smile1" in caught.value.where
    with pytest.raises(InputError, match="no expression"):
        subject_meshes("anna", neutral, [], skin)
