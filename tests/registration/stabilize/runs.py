"""A run on disk, as `gnmreg subject` would leave it, of subjects whose truth is known."""

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from bench.support.performances import ObservedSubject, TrueSubject
from registration.model import gnm_npz
from registration.model.gnm_npz import GNMData
from registration.storage.registration_folder import save_registration
from tests.registration.report.test_page import a_registration


def write_subject(folder: Path, name: str, data: GNMData, heads: dict[str, tuple[str, np.ndarray, np.ndarray]]) -> Path:
    """A subject folder; heads: registration -> (expression, vertices, confidence), the neutral first."""
    model = gnm_npz.content_hash(data)
    rows = []
    for row, (expression, vertices, confidence) in heads.items():
        result = a_registration(
            vertices=vertices.astype(np.float32),
            offsets=np.zeros(vertices.shape, np.float32),
            confidence=confidence.astype(np.float32),
            triangles=data.triangles.astype(np.int32),
            corner_uvs=np.zeros((len(data.triangles), 3, 2), np.float32),
            inputs={"model": model},
        )
        save_registration(result, folder / row, "<html></html>")
        rows.append({"name": row, "expression": expression, "status": "converged", "reason": "it rests", "folder": row})
    record = {"kind": "gnm-subject", "schema": 1, "subject": name, "model": model, "recipe": "draft", "captures": rows}
    (folder / "subject.json").write_text(json.dumps({**record, "neutral": next(iter(heads))}))
    return folder


def write_run(folder: Path, data: GNMData, truths: Sequence[TrueSubject], seens: Sequence[ObservedSubject]) -> Path:
    """One folder a subject."""
    for truth, seen in zip(truths, seens, strict=True):
        heads = {"rest": ("neutral", seen.neutral, seen.neutral_confidence)}
        for k, label in enumerate(truth.labels):
            heads[label] = (label, seen.vertices[k], seen.confidence[k])
        write_subject(folder / truth.name, truth.name, data, heads)
    return folder
