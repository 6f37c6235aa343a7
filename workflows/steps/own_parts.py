"""Gives all captures of a subject the same teeth and eyes: what their registrations show of them together."""

import shutil
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from registration.anatomy.own_parts import (
    FIGURE,
    OwnParts,
    PartEstimate,
    found_alone,
    fuse,
    record,
    views_that_see,
    with_parts,
)
from registration.evaluate.audit import audit_penetration
from registration.evaluate.viewpoint import intersection_figures
from registration.model.gnm_npz import GNMData
from registration.model.landmarks import LandmarkScheme
from registration.report.summary import refresh_report
from registration.storage.hashing import hash_fields
from registration.storage.registration_folder import REPORT, SPARSE, load_registration, save_registration
from registration.types import Capture, Registration

_NOTE = "teeth and eyes are what all captures of the subject show of them together"


@dataclass(frozen=True, kw_only=True)
class _Shown:
    """A registration as it was written first, and what it says of the subject's own parts."""

    capture: Capture
    folder: Path
    registration: Registration  # as it lies in the folder
    digest: str
    estimate: PartEstimate


def share_own_parts(
    captures: Mapping[Path, Capture], data: GNMData, schemes: Mapping[str, LandmarkScheme]
) -> dict[Path, Registration]:
    """Fuse what registrations of one subject found of its teeth and eyes, and write the result into all of them.

    Args:
        captures: folder of a usable registration -> its capture; the neutral's first.
        data: the model.
        schemes: its landmark schemes.

    Returns:
        The registrations that were written again: only vertices of these parts have changed, and landmarks on them.
        Empty if the model has no such components, there is one capture alone, or all of them have the result already.
    """
    parts = OwnParts.of(data)
    if not len(parts.components) or len(captures) < 2:
        return {}
    shown = [_shown(capture, folder, data, parts, schemes) for folder, capture in captures.items()]
    sources = {item.folder.name: item.digest for item in shown}
    if all(_sources(item.registration) == sources for item in shown):
        return {}
    fused = fuse(parts, [item.estimate for item in shown])
    return {
        item.folder: _write(item, data, parts, coefficients, schemes, sources)
        for item, coefficients in zip(shown, fused, strict=True)
    }


def _sources(registration: Registration) -> Mapping[str, str] | None:
    entry = registration.figures.get(FIGURE)
    return entry["from"] if entry else None


def _shown(
    capture: Capture, folder: Path, data: GNMData, parts: OwnParts, schemes: Mapping[str, LandmarkScheme]
) -> _Shown:
    written = load_registration(folder)
    alone = found_alone(written, data, parts, schemes)
    cameras = [view.camera for view in capture.views]
    views = views_that_see(alone.vertices.astype(np.float64), alone.triangles, cameras, parts.vertices)
    entry = written.figures.get(FIGURE)
    return _Shown(
        capture=capture,
        folder=folder,
        registration=written,
        digest=entry["digest"] if entry else hash_fields(written),
        estimate=PartEstimate(
            coefficients=parts.coefficients(alone), views=views, jaw=parts.jaw_motion(data, alone.expression)
        ),
    )


def _write(
    item: _Shown,
    data: GNMData,
    parts: OwnParts,
    coefficients: np.ndarray,
    schemes: Mapping[str, LandmarkScheme],
    sources: Mapping[str, str],
) -> Registration:
    entry = {
        "digest": item.digest,
        **record(parts, item.estimate.coefficients),
        "vertices_seen": int((item.estimate.views > 0).sum()),
        "from": dict(sources),
    }
    changed = with_parts(item.registration, data, parts, coefficients, schemes)
    notes = [note for note in changed.figures.get("notes", []) if note != _NOTE]
    figures = {**changed.figures, FIGURE: entry, "notes": [*notes, _NOTE]}
    cameras = {view.name: view.camera for view in item.capture.views}
    audit = audit_penetration(changed.vertices, data, scale=float(changed.scale))
    figures["intersections"] = intersection_figures(audit, changed.vertices, cameras)
    changed = replace(changed, figures=figures)
    report, sparse = item.folder / REPORT, item.folder / SPARSE
    page = report.read_text(encoding="utf-8") if report.is_file() else None
    copy_sparse = partial(shutil.copytree, sparse) if sparse.is_dir() else None
    save_registration(changed, item.folder, page, write_sparse=copy_sparse)
    refresh_report(item.folder)
    return changed
