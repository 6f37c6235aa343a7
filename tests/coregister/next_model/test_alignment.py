"""Generalized Procrustes alignment of neutrals, and outliers."""

import numpy as np
import pytest

from coregister.next_model.alignment import align_neutrals
from registration.frames import transform_points
from registration.model.gnm_npz import GNMData
from registration.stabilize.subject_meshes import SkullSkin
from tests.coregister.next_model import samples

COUNT = 12


@pytest.fixture(scope="module")
def scattered(model: GNMData) -> np.ndarray:
    rng = np.random.default_rng(0)
    still = samples.heads(model, rng.normal(size=(COUNT, len(samples.head_components(model)))))
    return samples.transformed(still, rng).astype(np.float32)


def _names(count: int = COUNT) -> list[str]:
    return [f"subject {k}" for k in range(count)]


def _observed(heads: np.ndarray) -> np.ndarray:
    return np.ones(heads.shape[:2], np.float32)


def test_heads_are_aligned_with_their_mean_and_the_mean_with_the_template(model, scattered):
    aligned = align_neutrals(scattered, _observed(scattered), _names(), model)
    assert aligned.rejected == () and 2 <= aligned.iterations < 20
    stable = SkullSkin.from_model(model).area
    for T, head, source in zip(aligned.T_model_head, aligned.vertices, scattered, strict=True):
        np.testing.assert_allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-12)
        assert np.linalg.det(T[:3, :3]) == pytest.approx(1)
        assert np.abs(transform_points(T, source.astype(np.float64)) - head).max() < 1e-6
    np.testing.assert_allclose(aligned.mean, aligned.vertices.mean(0), atol=1e-6)
    # Force and torque of the residuals vanish: no rigid motion reduces them.
    for a, b in [*((head, aligned.mean) for head in aligned.vertices), (aligned.mean, model.template_vertex_positions)]:
        residual, arm = (a - b).astype(np.float64), b - stable @ b / stable.sum()
        force, torque = stable @ residual, stable @ np.cross(arm, residual)
        assert np.linalg.norm(force) / stable.sum() < 3e-6 and np.linalg.norm(torque) / stable.sum() < 3e-7


def test_the_result_does_not_depend_on_the_heads_poses(model, scattered):
    again = samples.transformed(scattered, np.random.default_rng(5)).astype(np.float32)
    first, second = (align_neutrals(heads, _observed(heads), _names(), model) for heads in (scattered, again))
    assert np.abs(first.vertices - second.vertices).max() < 5e-6


def test_no_head_is_reflected(model, scattered):
    mirrored = scattered.copy()
    mirrored[3, :, 0] *= -1
    aligned = align_neutrals(mirrored, _observed(mirrored), _names(), model)
    assert (np.linalg.det(aligned.T_model_head[:, :3, :3]) > 0).all()


def _swollen(heads: np.ndarray) -> None:
    heads[4] = heads[4].mean(0) + 1.35 * (heads[4] - heads[4].mean(0))


def _noisy(heads: np.ndarray) -> None:
    heads[4] += np.random.default_rng(1).normal(0, 1e-3, heads[4].shape).astype(np.float32)


def _with_a_spike(heads: np.ndarray) -> None:
    near = np.linalg.norm(heads[4] - heads[4][heads[4][:, 2].argmax()], axis=1) < 0.02
    heads[4][near] += np.float32(0.04)


@pytest.mark.parametrize("damage, word", [(_swollen, "from the mean"), (_noisy, "rough"), (_with_a_spike, "mm")])
def test_an_outlier_is_rejected_by_name(model, scattered, damage, word):
    heads = scattered.copy()
    damage(heads)
    aligned = align_neutrals(heads, _observed(heads), _names(), model)
    assert [subject.name for subject in aligned.rejected] == ["subject 4"] and word in aligned.rejected[0].reason
    assert aligned.kept.tolist() == [k for k in range(COUNT) if k != 4]
    without = align_neutrals(np.delete(heads, 4, 0), _observed(heads)[1:], _names(COUNT - 1), model)
    assert np.abs(without.mean - aligned.mean).max() < 1e-9


def test_unobserved_skin_does_not_affect_alignment(model, scattered):
    hidden, confidence = scattered.copy(), _observed(scattered)
    side = model.template_vertex_positions[:, 0] > 0.05
    hidden[2, side] += np.float32(0.05)
    confidence[2, side] = 0
    aligned = align_neutrals(hidden, confidence, _names(), model)
    clean = align_neutrals(scattered, confidence, _names(), model)
    assert aligned.rejected == () and np.abs(aligned.T_model_head - clean.T_model_head).max() < 1e-6


def test_mirrored_heads_give_mirrored_results(model):
    """About the plane x = 0."""
    rng = np.random.default_rng(6)
    heads = samples.heads(model, rng.normal(size=(6, len(samples.head_components(model)))))
    heads[:, :, 0] += 0.02 * np.maximum(heads[:, :, 0], 0)  # wider on one side
    heads = samples.transformed(heads, rng)
    mirror, flip = model.mirror_indices, (-1, 1, 1)
    confidence = rng.uniform(0.2, 1, heads.shape[:2]).astype(np.float32)
    names = [str(k) for k in range(6)]
    original = align_neutrals(heads.astype(np.float32), confidence, names, model, mirrored=True)
    mirrored_result = align_neutrals(
        (heads[:, mirror] * flip).astype(np.float32), confidence[:, mirror], names, model, mirrored=True
    )
    assert np.abs(mirrored_result.vertices - original.vertices[:, mirror] * flip).max() < 2e-6
    unpaired = align_neutrals(heads.astype(np.float32), confidence, names, model)
    assert np.abs(unpaired.vertices - original.vertices).max() > 1e-5
