"""Registrations on disk whose figures are chosen."""

import json
from pathlib import Path
from typing import Any

import numpy as np

from registration.storage.registration_folder import read_manifest, save_registration
from registration.types import Status
from tests.registration.report.test_page import a_registration
from workflows.gate.items import Found
from workflows.records.subject import CaptureRow, SubjectRecord

VIEWS = ("cam0", "cam1", "cam2", "cam3")
GOOD = {
    "silhouette_px": 0.6,
    "normals_deg": 2.0,
    "colour_levels": 4.0,
    "labels_percent": 2.0,
    "landmarks_px": 1.5,
}


def figures(worst: str = "", factor: float = 1.0, **residuals: float) -> dict[str, Any]:
    """Return a manifest's figures of a registration without a scan; of the residual `worst` the last view is worse."""
    overall = {**GOOD, **residuals}
    views = {name: dict(overall) for name in VIEWS}
    if worst:
        views[VIEWS[-1]][worst] *= factor
    return {
        "residuals": {"overall": overall, "views": views},
        "views_not_trusted": {},
        "motion_mm": 0.01,
        "intersections": {"pairs": {"lips in teeth": {"max_excess_mm": 0.4, "vertices_beyond_0.3mm": 2}}},
        "reversed_skin": {"area_mm2": 0.0, "places": {}},
        "from_model": {"identity_sigmas": 0.8, "expression_sigmas": 0.5, "offset_sigmas": 0.2, "size_percent": 1.0},
    }


def write(folder: Path, status: Status = "converged", seed: int = 0, **values: Any) -> Path:
    """Write a registration with these figures; every seed gives another content id."""
    vertices = np.random.default_rng(seed).normal(size=(4, 3)).astype(np.float32)
    registration = a_registration(status=status, vertices=vertices, figures=values or figures())
    return save_registration(registration, folder)


def write_subject(folder: Path, seed: int, captures: dict[str, dict[str, Any]]) -> Path:
    """Write a subject's folder; captures: name -> figures, the neutral's first."""
    for number, (name, values) in enumerate(captures.items()):
        write(folder / name, seed=100 * seed + number, **values)
    rows = tuple(CaptureRow(name=n, expression=n, status="converged", folder=n) for n in captures)
    neutral = next(iter(captures))
    record = SubjectRecord(subject=folder.name, model="m", recipe="draft", neutral=neutral, rows=rows)
    record.write(folder / "subject.json")
    return folder


def found(folder: Path) -> Found:
    return Found(name=folder.name, place=str(folder), manifest=read_manifest(folder))


def lines(file: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in file.read_text().splitlines()]
