"""What was not seen follows the model, what was stays."""

import numpy as np
import pytest

from coregister.next_model.completion import CompletionSettings, MissingDataCompletion
from registration.model import regions
from tests.coregister.next_model import known


@pytest.fixture(scope="module")
def complete(model) -> MissingDataCompletion:
    return MissingDataCompletion(model, model.vertex_identity_basis, CompletionSettings())


@pytest.fixture(scope="module")
def hidden(model) -> np.ndarray:
    """The back of the head: confidence 0, and rising from 0 to 1 along 3 cm before it."""
    return np.clip((model.template_vertex_positions[:, 2] - 0.0) / 0.03, 0, 1).astype(np.float32)


def test_with_everything_seen_nothing_changes(complete, model):
    moved = np.random.default_rng(0).normal(0, 1e-3, model.template_vertex_positions.shape)
    sure = np.ones(len(moved), np.float32)
    assert not complete.has_missing(sure) and complete(moved, sure) is moved
    # Linings that no camera sees do not count, as long as the outside is seen.
    assert not complete.has_missing(regions.exterior(model).astype(np.float32))


def test_what_the_model_spans_is_guessed_from_the_face(complete, model, hidden):
    rng = np.random.default_rng(1)
    c = rng.normal(size=len(known.head_components(model)))
    truth = np.tensordot(c, known.head_components(model), 1)
    wrong = truth + 0.03 * (hidden == 0)[:, None]
    assert complete.has_missing(hidden)
    found = complete(wrong, hidden)
    skin = regions.skin(model)
    assert np.abs(found - truth)[skin & (hidden >= 0.1)].max() < 1e-9
    away = np.linalg.norm(found - truth, axis=1)[regions.exterior(model) & (hidden == 0)]
    still = np.linalg.norm(truth, axis=1)[regions.exterior(model) & (hidden == 0)]
    print(f"unseen: {1e3 * away.mean():.2f} mm off, {1e3 * still.mean():.2f} without a guess")
    assert away.mean() < 0.25 * still.mean()


def test_teeth_tongue_and_eyes_stay_as_they_came(complete, model, hidden):
    inside = ~regions.skin(model)
    moved = np.full(model.template_vertex_positions.shape, 0.004)
    found = complete(moved, np.where(inside, 0, hidden).astype(np.float32))
    np.testing.assert_allclose(found[inside], moved[inside], atol=1e-12)


def test_what_the_model_does_not_span_fades_out_beyond_the_border(complete, model, hidden):
    """A bump across the border goes on smoothly, and is gone further away; nowhere is there a jump."""
    points = model.template_vertex_positions.astype(np.float64)
    shift = np.full_like(points, 0.004)
    found = complete(shift, hidden)
    guess = complete._estimate(shift, np.clip(hidden / CompletionSettings().min_confidence, 0, 1))
    edges = model.triangles[:, [0, 1]]
    on_skin = regions.exterior(model)[edges].all(1)
    step = np.linalg.norm((found - guess)[edges[:, 0]] - (found - guess)[edges[:, 1]], axis=1)[on_skin]
    length = np.linalg.norm(points[edges[:, 0]] - points[edges[:, 1]], axis=1)[on_skin]
    most = np.linalg.norm(shift - guess, axis=1).max()
    assert (step / length).max() < 1.5 * most / (CompletionSettings().fade_mm / 1000) + np.abs(guess).max() / 0.01
    far = regions.exterior(model) & (points[:, 2] < -0.06)
    assert far.any() and np.linalg.norm(found - guess, axis=1)[far].max() < 0.1 * most
