"""Neutrals laid upon one another."""

import numpy as np
import pytest

from coregister.next_model.alignment import align_neutrals
from registration.frames import transform_points
from registration.model.gnm_npz import GNMData
from registration.stabilize.subject_meshes import SkullSkin
from tests.coregister.next_model import known

COUNT = 12


@pytest.fixture(scope="module")
def scattered(model: GNMData) -> np.ndarray:
    rng = np.random.default_rng(0)
    still = known.heads(model, rng.normal(size=(COUNT, len(known.head_components(model)))))
    return known.moved(still, rng).astype(np.float32)


def _names(count: int = COUNT) -> list[str]:
    return [f"subject {k}" for k in range(count)]


def _sure(heads: np.ndarray) -> np.ndarray:
    return np.ones(heads.shape[:2], np.float32)


def test_heads_lie_on_their_mean_and_it_on_the_template(model, scattered):
    found = align_neutrals(scattered, _sure(scattered), _names(), model)
    assert found.rejected == () and 2 <= found.iterations < 20
    stable = SkullSkin.of(model).area
    for T, head, source in zip(found.T_model_head, found.vertices, scattered, strict=True):
        np.testing.assert_allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-12)
        assert np.linalg.det(T[:3, :3]) == pytest.approx(1)
        assert np.abs(transform_points(T, source.astype(np.float64)) - head).max() < 1e-6
    np.testing.assert_allclose(found.mean, found.vertices.mean(0), atol=1e-6)
    # Neither a head against the mean nor the mean against the template can be turned for the better.
    for a, b in [*((head, found.mean) for head in found.vertices), (found.mean, model.template_vertex_positions)]:
        away, arm = (a - b).astype(np.float64), b - stable @ b / stable.sum()
        force, torque = stable @ away, stable @ np.cross(arm, away)
        assert np.linalg.norm(force) / stable.sum() < 3e-6 and np.linalg.norm(torque) / stable.sum() < 3e-7


def test_where_heads_stood_does_not_matter(model, scattered):
    again = known.moved(scattered, np.random.default_rng(5)).astype(np.float32)
    one, two = (align_neutrals(heads, _sure(heads), _names(), model) for heads in (scattered, again))
    assert np.abs(one.vertices - two.vertices).max() < 5e-6


def test_a_mirrored_head_is_not_unmirrored(model, scattered):
    mirrored = scattered.copy()
    mirrored[3, :, 0] *= -1
    found = align_neutrals(mirrored, _sure(mirrored), _names(), model)
    assert (np.linalg.det(found.T_model_head[:, :3, :3]) > 0).all()


def _swollen(heads: np.ndarray) -> None:
    heads[4] = heads[4].mean(0) + 1.35 * (heads[4] - heads[4].mean(0))


def _noisy(heads: np.ndarray) -> None:
    heads[4] += np.random.default_rng(1).normal(0, 1e-3, heads[4].shape).astype(np.float32)


def _with_a_spike(heads: np.ndarray) -> None:
    near = np.linalg.norm(heads[4] - heads[4][heads[4][:, 2].argmax()], axis=1) < 0.02
    heads[4][near] += np.float32(0.04)


@pytest.mark.parametrize("spoil, word", [(_swollen, "from the mean"), (_noisy, "rough"), (_with_a_spike, "mm")])
def test_one_spoiled_head_is_left_out_and_named(model, scattered, spoil, word):
    heads = scattered.copy()
    spoil(heads)
    found = align_neutrals(heads, _sure(heads), _names(), model)
    assert [one.name for one in found.rejected] == ["subject 4"] and word in found.rejected[0].reason
    assert found.kept.tolist() == [k for k in range(COUNT) if k != 4]
    without = align_neutrals(np.delete(heads, 4, 0), _sure(heads)[1:], _names(COUNT - 1), model)
    assert np.abs(without.mean - found.mean).max() < 1e-9


def test_unseen_skin_has_no_say(model, scattered):
    hidden, sure = scattered.copy(), _sure(scattered)
    side = model.template_vertex_positions[:, 0] > 0.05
    hidden[2, side] += np.float32(0.05)
    sure[2, side] = 0
    found = align_neutrals(hidden, sure, _names(), model)
    clean = align_neutrals(scattered, sure, _names(), model)
    assert found.rejected == () and np.abs(found.T_model_head - clean.T_model_head).max() < 1e-6


def test_mirror_images_are_aligned_as_the_heads_are(model):
    """Mirrored heads give the mirror images of what the heads give, about the plane x = 0."""
    rng = np.random.default_rng(6)
    heads = known.heads(model, rng.normal(size=(6, len(known.head_components(model)))))
    heads[:, :, 0] += 0.02 * np.maximum(heads[:, :, 0], 0)  # all are wider on one side
    heads = known.moved(heads, rng)
    mirror, flip = model.mirror_indices, (-1, 1, 1)
    sure = rng.uniform(0.2, 1, heads.shape[:2]).astype(np.float32)
    names = [str(k) for k in range(6)]
    one = align_neutrals(heads.astype(np.float32), sure, names, model, mirrored=True)
    two = align_neutrals((heads[:, mirror] * flip).astype(np.float32), sure[:, mirror], names, model, mirrored=True)
    assert np.abs(two.vertices - one.vertices[:, mirror] * flip).max() < 2e-6
    alone = align_neutrals(heads.astype(np.float32), sure, names, model)
    assert np.abs(alone.vertices - one.vertices).max() > 1e-5
