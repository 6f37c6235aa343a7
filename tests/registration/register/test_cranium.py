"""A cranium that no camera sees: the auxiliary model beside the head model completes it, and the face stays."""

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from coregister.anatomy.cranium_model import build_cranium_model
from registration.cranium import auxiliary_model
from registration.model import gnm_npz, regions
from registration.options import RegisterOptions
from registration.pipeline import register
from registration.storage.registration_folder import load_registration
from tests.registration.register.synthetic import MODEL, Truth

pytestmark = pytest.mark.slow
OPTIONS = RegisterOptions(recipe="preview", deterministic=True)


def test_the_unseen_cranium_is_that_of_the_auxiliary_model(neutral: Truth, tmp_path: Path) -> None:
    """The cameras stand in front and do not see the back of the head; the auxiliary heads are of the head model."""
    model, data = tmp_path / "model" / MODEL.name, gnm_npz.read(MODEL)
    model.parent.mkdir()
    shutil.copy(MODEL, model)
    off = register(neutral.root, model, tmp_path / "off", OPTIONS)
    assert off.figures["cranium"]["completed_by"] == "fit" and off.figures["cranium"]["hidden_share"] > 0.1
    assert any("no auxiliary model" in note for note in off.figures["notes"])
    weights = np.random.default_rng(0).normal(size=(40, len(data.vertex_identity_basis)))
    heads = data.template_vertex_positions + np.tensordot(weights, data.vertex_identity_basis, 1)
    auxiliary_model.write(build_cranium_model(data, heads, seed=0, source="the model"), auxiliary_model.beside(model))
    completed = register(neutral.root, model, tmp_path / "model_fill", OPTIONS)
    assert completed.figures["cranium"]["completed_by"] == "model" and "cranium" in completed.inputs
    with np.load(tmp_path / "model_fill" / "cranium.npz") as arrays:
        hidden, deviation = arrays["hidden"], arrays["deviation"]
    assert hidden.any() and not hidden[~(regions.cranium(data) | regions.neck_other(data))].any()
    assert (deviation[hidden & regions.cranium(data)] > 0).all()
    moved_mm = 1000 * np.linalg.norm(completed.vertices - off.vertices, axis=1)
    assert moved_mm[~hidden].max() < 1e-3 < moved_mm[hidden].max()
    np.testing.assert_array_equal(load_registration(tmp_path / "model_fill").vertices, completed.vertices)
    again = register(neutral.root, model, tmp_path / "again", replace(OPTIONS, cranium="off"))
    np.testing.assert_array_equal(again.vertices, off.vertices)
    assert not (tmp_path / "again" / "cranium.npz").exists()
