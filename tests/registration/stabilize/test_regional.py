"""Head motion that was added to expressions is removed; expressions stay."""

import numpy as np
import pytest

from bench.support import performances, stabilization_measures
from registration.errors import InputError
from registration.geometry.rigid import motion_fields
from registration.stabilize.components import label_effects, label_independence, regional_components
from registration.stabilize.decisions import (
    Decision,
    compute_corrections,
    correction_effect,
    decided_actions,
    default_actions,
)


@pytest.fixture(scope="module")
def injected(truths, model):
    return stabilization_measures.remove_injected_motion(truths, model, seed=0)


def test_most_of_an_injected_motion_is_removed_and_expressions_stay(injected):
    assert injected.reduced > 0.8 and injected.lost < 0.03
    flagged = {part.region: part.flagged for part in injected.components}
    assert flagged["neck_back"].any() and not flagged["mouth"].any()


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(3))
def test_motion_in_a_third_of_400_samples_is_removed(head_assembly, model, seed):
    truths = [performances.true_subject(head_assembly, 1000 + number) for number in range(20)]
    result = stabilization_measures.remove_injected_motion(truths, model, seed)
    assert result.reduced >= 0.8 and result.lost < 0.02


def test_true_expressions_are_not_flagged(truths, head):
    true = np.concatenate([truth.vertices - truth.neutral for truth in truths]).astype(np.float32)
    labels = [label for truth in truths for label in truth.labels]
    parts = regional_components(list(true), labels, head)
    assert not any(part.flagged.any() for part in parts)
    jaw = next(part for part in parts if part.region == "mouth")
    assert jaw.rigidity[0] > 0.5 and jaw.shared_motion[0] < 0.5  # rigid, but nose and neck do not share it
    for part in parts:
        assert part.energy.sum() >= 0.99 and (np.diff(part.energy) <= 1e-9).all()
        np.testing.assert_allclose(part.rigid_size_ratio, np.sqrt(part.rigid_fit_r2), atol=1e-6)


def test_a_pure_head_motion_is_subtracted(head):
    rng = np.random.default_rng(0)
    spurious = rng.normal(size=(40, 2)) @ (rng.normal(size=(2, 6)) * np.repeat([0.01, 0.002], 3))
    displaced = np.tensordot(spurious, motion_fields(head.points), 1).astype(np.float32)
    labels = [f"label {k % 4}" for k in range(40)]
    parts = regional_components(list(displaced), labels, head)
    assert all(part.flagged[:2].all() for part in parts)
    corrections = compute_corrections(
        parts, decided_actions(parts, [keep_labels(p.region, k) for p in parts for k in (0, 1)]), labels, head
    )
    # What the four labels explain by chance stays.
    assert np.linalg.norm(corrections.twists - spurious) < 0.25 * np.linalg.norm(spurious)
    assert correction_effect(corrections, head).rms_mm > 0.5


def keep_labels(region: str, component: int) -> Decision:
    return Decision(region=region, component=component, action="subtract")


def test_dropping_removes_the_component_in_its_region_only(injected, truths, head):
    labels = [label for truth in truths for label in truth.labels]
    parts = injected.components
    mouth = next(part for part in parts if part.region == "mouth")
    actions = {key: "keep" for key in default_actions(parts)} | {("mouth", 0): "drop"}
    corrections = compute_corrections(parts, actions, labels, head)
    assert not corrections.twists.any()
    sample = int(np.abs(mouth.coefficients[:, 0]).argmax())
    removed = head.points - corrections.apply(head.points, sample)
    outside = np.setdiff1d(np.arange(len(head.points)), mouth.rows)
    np.testing.assert_allclose(removed[outside], 0, atol=1e-12)
    full = mouth.coefficients[sample, 0] * mouth.modes[0]
    ratio = np.linalg.norm(removed[mouth.rows], axis=1) / np.linalg.norm(full, axis=1)
    assert ratio.min() < 0.2 and np.isclose(ratio.max(), 1)
    assert np.isclose(correction_effect(corrections, head).samples_mm.argmax(), sample)


def test_motions_are_undone(injected, truths, head):
    labels = [label for truth in truths for label in truth.labels]
    corrections = compute_corrections(injected.components, default_actions(injected.components), labels, head)
    transform = corrections.T_corrected_head(0)
    np.testing.assert_allclose(transform[:3, :3] @ transform[:3, :3].T, np.eye(3), atol=1e-12)
    displaced = head.points + np.tensordot(corrections.twists[0], motion_fields(head.points), 1)
    # The displacement is linear in the rotation, the correction is not.
    assert np.abs(corrections.apply(displaced, 0) - head.points).max() < 2e-4


def test_labels_explain_what_depends_on_them():
    labels = np.repeat(["a", "b", "c", "d", "e"], 40).tolist()
    rng = np.random.default_rng(0)
    noise = rng.normal(size=(200, 300))
    assert abs(label_independence(noise, labels).mean() - 1) < 0.02
    few = np.repeat(np.arange(20), 2).astype(str).tolist()
    assert 0.85 < label_independence(rng.normal(size=(40, 300)), few).mean() <= 1  # 1 - eta^2 would be 0.5
    effect = np.repeat([-4.0, 0, 1, 2, 5], 40)[:, None] + 0.3 * noise[:, :1]
    assert label_independence(effect, labels)[0] < 0.02
    np.testing.assert_allclose(label_effects(effect, labels)[:, 0], np.repeat([-4.0, 0, 1, 2, 5], 40), atol=0.2)
    assert np.abs(label_effects(noise, labels)).mean() < 0.1  # plain means are twice that
    assert label_independence(noise, [str(k) for k in range(200)]).max() == 0


def test_bad_samples_and_decisions_are_refused(head, injected):
    zeros = np.zeros((len(head.points), 3), np.float32)
    with pytest.raises(InputError, match="too few samples"):
        regional_components([zeros], ["a"], head)
    with pytest.raises(InputError, match="not finite"):
        regional_components([zeros, zeros * np.nan], ["a", "b"], head)
    for region, component in (("knee", 0), ("nose", 99)):
        with pytest.raises(InputError, match="does not exist"):
            decided_actions(injected.components, [Decision(region=region, component=component, action="keep")])


def test_motion_is_shared_if_nose_and_neck_both_share_it(head):
    """A motion of mouth and nose alone, as of a sneer, is no head motion, however similar the nose's is."""
    rng = np.random.default_rng(1)
    field = np.tensordot(np.r_[0.02, 0.01, 0.01, 0.001, 0.002, 0.001], motion_fields(head.points), 1)
    labels = [f"label {k % 4}" for k in range(40)]
    for still, shared in ((("neck_back",), False), ((), True)):
        moved = field.copy()
        for name in still:
            moved[head.regions[name]] = 0
        displaced = (rng.normal(size=(40, 1, 1)) * moved).astype(np.float32)
        mouth = next(part for part in regional_components(list(displaced), labels, head) if part.region == "mouth")
        assert mouth.rigidity[0] > 0.9 and mouth.label_independence[0] > 0.7
        assert mouth.flagged[0] == shared and (mouth.shared_motion[0] > 0.9) == shared
        assert shared or mouth.shared_motion[0] < 0.1


def test_what_labels_explain_is_not_subtracted(head):
    """Of a component that is subtracted, each label's own part is expression and stays."""
    rng = np.random.default_rng(2)
    group = np.arange(80) % 4
    chance, of_label = rng.normal(size=80), np.array([-6.0, -2.0, 3.0, 5.0])[group]
    twist = np.r_[0.004, 0.002, 0.003, 0.0005, 0.0002, 0.0004]
    field = np.tensordot(twist, motion_fields(head.points), 1)
    displaced = ((chance + of_label)[:, None, None] * field).astype(np.float32)
    labels = [f"label {k}" for k in group]
    parts = regional_components(list(displaced), labels, head)
    actions = decided_actions(parts, [keep_labels(part.region, 0) for part in parts])
    removed = compute_corrections(parts, actions, labels, head).twists @ twist / (twist @ twist)
    assert np.abs(removed - chance).std() < 0.3
    assert abs(np.corrcoef(removed, of_label)[0, 1]) < 0.2
