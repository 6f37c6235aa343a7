"""The page of a built model, with rendered images."""

import numpy as np

from coregister.next_model.build import build_model
from coregister.next_model.training_data import TrainingMesh, TrainingSubject
from registration.model import gnm_npz
from tests.workflows.rounds import MODEL, head
from workflows.pages import model


def test_the_page_shows_components_tables_and_rejected_subjects(monkeypatch):
    data = gnm_npz.read(MODEL)

    def mesh(name: str, vertices: np.ndarray) -> TrainingMesh:
        confidence = np.ones(len(vertices), np.float32)
        shape = vertices.astype(np.float32)
        return TrainingMesh(name=name, label=name, vertices=shape, confidence=confidence, triangles=data.triangles)

    subjects = []
    for seed in range(7):
        neutral = head(data, seed)
        neutral = neutral + (np.random.default_rng(0).normal(0, 8e-3, neutral.shape) if seed == 3 else 0)
        smile = mesh("smile", neutral + data.expression_basis[3])
        tags = {"age": 20 + 10 * seed, "gender": "female"}
        subjects.append(
            TrainingSubject(name=f"p<{seed}>", neutral=mesh("neutral", neutral), expressions=(smile,), tags=tags)
        )
    built = build_model(subjects, data)
    for name, value in {"IDENTITY": 2, "EXPRESSION": 1, "SIZE": (48, 52)}.items():
        monkeypatch.setattr(model, name, value)
    page = model.render_model_page(built.data, built.manifest)
    image_count = page.count('class="zoom"')
    assert image_count == 2 * 2 * (2 + len(built.manifest["expression"]))  # sides, ends, components
    for text in ("head_000, +2", "lower_face_region_000, −2", "p&lt;3&gt;", "20-29", "smile", "<svg"):
        assert text in page
    assert "<3>" not in page and 'src="http' not in page and 'href="http' not in page
    first, second = page.split('class="zoom"')[1:3]
    assert first != second
