"""Missing-data completion: unobserved skin follows the model, observed skin is kept."""

import numpy as np
import pytest

from coregister.next_model.completion import CompletionSettings, MissingDataCompletion
from registration.model import regions
from tests.coregister.next_model import samples


@pytest.fixture(scope="module")
def complete(model) -> MissingDataCompletion:
    return MissingDataCompletion(model, model.vertex_identity_basis, CompletionSettings())


@pytest.fixture(scope="module")
def hidden(model) -> np.ndarray:
    """Confidence 0 at the back of the head, increasing to 1 within 3 cm in front of it."""
    return np.clip((model.template_vertex_positions[:, 2] - 0.0) / 0.03, 0, 1).astype(np.float32)


def test_fully_observed_skin_is_unchanged(complete, model):
    displacement = np.random.default_rng(0).normal(0, 1e-3, model.template_vertex_positions.shape)
    confidence = np.ones(len(displacement), np.float32)
    assert not complete.has_missing(confidence) and complete(displacement, confidence) is displacement
    # Inner surfaces do not count while the exterior is observed.
    assert not complete.has_missing(regions.exterior(model).astype(np.float32))


def test_heads_in_the_models_span_are_estimated_from_the_face(complete, model, hidden):
    rng = np.random.default_rng(1)
    c = rng.normal(size=len(samples.head_components(model)))
    truth = np.tensordot(c, samples.head_components(model), 1)
    wrong = truth + 0.03 * (hidden == 0)[:, None]
    assert complete.has_missing(hidden)
    completed = complete(wrong, hidden)
    skin = regions.skin(model)
    assert np.abs(completed - truth)[skin & (hidden >= 0.1)].max() < 1e-9
    error = np.linalg.norm(completed - truth, axis=1)[regions.exterior(model) & (hidden == 0)]
    baseline = np.linalg.norm(truth, axis=1)[regions.exterior(model) & (hidden == 0)]
    print(f"unobserved: {1e3 * error.mean():.2f} mm off, {1e3 * baseline.mean():.2f} without an estimate")
    assert error.mean() < 0.25 * baseline.mean()


def test_teeth_tongue_and_eyes_are_unchanged(complete, model, hidden):
    inside = ~regions.skin(model)
    displacement = np.full(model.template_vertex_positions.shape, 0.004)
    completed = complete(displacement, np.where(inside, 0, hidden).astype(np.float32))
    np.testing.assert_allclose(completed[inside], displacement[inside], atol=1e-12)


def test_residuals_fade_out_beyond_the_border(complete, model, hidden):
    """A residual at the border continues smoothly and vanishes at a distance."""
    points = model.template_vertex_positions.astype(np.float64)
    shift = np.full_like(points, 0.004)
    completed = complete(shift, hidden)
    estimate = complete._estimate(shift, np.clip(hidden / CompletionSettings().min_confidence, 0, 1))
    edges = model.triangles[:, [0, 1]]
    on_skin = regions.exterior(model)[edges].all(1)
    step = np.linalg.norm((completed - estimate)[edges[:, 0]] - (completed - estimate)[edges[:, 1]], axis=1)[on_skin]
    length = np.linalg.norm(points[edges[:, 0]] - points[edges[:, 1]], axis=1)[on_skin]
    largest = np.linalg.norm(shift - estimate, axis=1).max()
    assert (step / length).max() < 1.5 * largest / (CompletionSettings().fade_mm / 1000) + np.abs(estimate).max() / 0.01
    far = regions.exterior(model) & (points[:, 2] < -0.06)
    assert far.any() and np.linalg.norm(completed - estimate, axis=1)[far].max() < 0.1 * largest
