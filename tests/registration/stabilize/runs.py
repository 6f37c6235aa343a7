"""Write the run of subjects with known truth, as `gnmreg subject` does."""

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from bench.support.performances import ObservedSubject, TrueSubject
from registration.model import gnm_npz
from registration.model.gnm_npz import GNMData
from registration.storage.registration_folder import save_registration
from tests.registration.report.test_page import a_registration


def write_subject(
    folder: Path,
    name: str,
    data: GNMData,
    heads: dict[str, tuple[str, np.ndarray, np.ndarray]],
    coefficients: dict[str, dict[str, np.ndarray]] | None = None,
) -> Path:
    """Write a subject folder; heads: registration -> (expression, vertices, confidence), the neutral first.

    Coefficients: registration -> its `identity` and `expression`.
    """
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
            **(coefficients or {}).get(row, {}),
        )
        save_registration(result, folder / row, "<html></html>")
        rows.append(
            {"name": row, "expression": expression, "status": "converged", "reason": "tolerance reached", "folder": row}
        )
    record = {"kind": "gnm-subject", "schema": 1, "subject": name, "model": model, "recipe": "draft", "captures": rows}
    (folder / "subject.json").write_text(json.dumps({**record, "neutral": next(iter(heads))}))
    return folder


def write_run(
    folder: Path, data: GNMData, truths: Sequence[TrueSubject], observations: Sequence[ObservedSubject]
) -> Path:
    """Write one folder per subject."""
    for truth, observed in zip(truths, observations, strict=True):
        heads = {"rest": ("neutral", observed.neutral, observed.neutral_confidence)}
        for k, label in enumerate(truth.labels):
            heads[label] = (label, observed.vertices[k], observed.confidence[k])
        write_subject(folder / truth.name, truth.name, data, heads)
    return folder
