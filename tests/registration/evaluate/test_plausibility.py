"""Distances of a registered head from the model and from its neutral."""

from dataclasses import replace

import numpy as np
import pytest

from registration.evaluate.plausibility import plausibility, texture_dissimilarity
from registration.model import gnm_npz
from registration.model.atlas import texture_atlas
from registration.types import Registration
from tests.registration.register.synthetic import MODEL
from tests.registration.report.test_page import a_registration


@pytest.fixture(scope="module")
def data():
    return gnm_npz.read(MODEL)


def a_head(data, seed: int = 0, **changes) -> Registration:
    count = len(data.template_vertex_positions)
    texture = np.random.default_rng(seed).uniform(0.1, 0.9, (64, 64, 3)).astype(np.float32)
    fields = dict(
        identity=np.zeros(len(data.vertex_identity_basis), np.float32),
        expression=np.zeros(len(data.expression_basis), np.float32),
        rotations=np.zeros((len(data.joint_names), 3), np.float32),
        offsets=np.zeros((count, 3), np.float32),
        vertices=data.template_vertex_positions.astype(np.float32),
        confidence=np.ones(count, np.float32),
        triangles=data.triangles.astype(np.int32),
        corner_uvs=texture_atlas(data),
        texture=texture,
    )
    return a_registration(**{**fields, **changes})


def test_the_mean_head_has_no_distance(data):
    figures = plausibility(a_head(data), data)
    assert figures == {"from_model": dict.fromkeys(figures["from_model"], 0.0)}


def test_coefficients_and_offsets_are_root_mean_squares(data):
    offsets = np.zeros_like(data.template_vertex_positions)
    offsets[:, 0] = 2e-3
    identity = np.array([3.0, *np.zeros(len(data.vertex_identity_basis) - 1)], np.float32)
    head = a_head(data, offsets=offsets.astype(np.float32), identity=identity, scale=np.array(0.9, np.float32))
    figures = plausibility(head, data)["from_model"]
    assert figures["identity_sigmas"] == pytest.approx(3 / np.sqrt(len(identity)))
    assert figures["offsets_mm"] == pytest.approx(2.0) and figures["size_percent"] == pytest.approx(10.0)
    wider = replace(data, vertex_identity_basis=2 * data.vertex_identity_basis + 1e-3)
    assert plausibility(head, wider)["from_model"]["offset_sigmas"] < figures["offset_sigmas"]


def test_what_no_camera_saw_does_not_count(data):
    offsets = np.zeros_like(data.template_vertex_positions, dtype=np.float32)
    offsets[::2] = 5e-3
    confidence = np.ones(len(offsets), np.float32)
    confidence[::2] = 0.1
    assert plausibility(a_head(data, offsets=offsets, confidence=confidence), data)["from_model"]["offsets_mm"] == 0


def test_an_expression_is_compared_with_its_neutral(data):
    neutral = a_head(data)
    assert plausibility(neutral, data, neutral)["from_neutral"] == {"offsets_mm": 0.0, "texture": pytest.approx(0.0)}
    other = a_head(data, seed=1, offsets=np.full_like(neutral.offsets, 1e-3))
    figures = plausibility(other, data, neutral)["from_neutral"]
    assert figures["offsets_mm"] == pytest.approx(np.sqrt(3)) and 0.5 < figures["texture"] < 1.5


def test_a_little_noise_is_a_little_dissimilar(data):
    neutral = a_head(data)
    noise = np.random.default_rng(2).normal(0, 0.02, neutral.texture.shape).astype(np.float32)
    noisy = replace(neutral, texture=np.clip(neutral.texture + noise, 0, 1))
    everywhere = np.ones(len(neutral.vertices), bool)
    small = texture_dissimilarity(noisy, neutral, everywhere)
    large = texture_dissimilarity(a_head(data, seed=1), neutral, everywhere)
    assert small is not None and large is not None and 0 < small < 0.1 < large
    assert texture_dissimilarity(noisy, neutral, ~everywhere) is None
