"""The HTML page of a stabilized set: self-contained."""

from collections.abc import Iterable, Iterator, Sequence
from itertools import islice
from typing import Any

import numpy as np
from markupsafe import Markup

from registration.report.inputs import HeatMap
from registration.report.loss_curves import loss_curves
from registration.stabilize.components import HeadGeometry, RegionalComponents
from registration.stabilize.pipeline import StabilizedSubject
from registration.stabilize.stabilized_folder import StabilizedManifest
from workflows.pages.base import heat_images, render

LIMIT_MM = 2.0  # at the end of the colour scale
_MAX_SUBJECTS = 12  # with maps; a page of hundreds would be too large to open


def render_stabilization_page(
    manifest: StabilizedManifest,
    components: Sequence[RegionalComponents],
    subjects: Iterable[StabilizedSubject],
    head: HeadGeometry,
) -> str:
    """Return the page: maps and residuals of the first subjects, and all components with their scores."""
    figures = manifest.figures
    tiles = (
        (f"{figures['samples']}", "", f"expressions of {len(manifest.subjects)} subjects"),
        (f"{figures['residual_median_mm']:.2f}", "mm", "median residual of the skin that follows the skull"),
        (f"{figures['regional_turn_deg']:.2f}", "°", "rotation by the second stage, rms"),
        (f"{figures['regional_rms_mm']:.2f}", "mm", "displacement by the second stage, rms"),
    )
    half_weight_mm = manifest.config["automatic"]["half_weight_mm"]
    shown = [_subject(subject, head, half_weight_mm) for subject in islice(subjects, _MAX_SUBJECTS)]
    return render(
        "stabilization.html",
        dataset=manifest.dataset,
        tiles=tiles,
        limit_mm=LIMIT_MM,
        subjects=shown,
        not_shown=len(manifest.subjects) - len(shown),
        components=[row for part in components for row in _rows(part, head)],
    )


def _subject(subject: StabilizedSubject, head: HeadGeometry, half_weight_mm: float) -> dict[str, Any]:
    weight = subject.confidence_map.astype(np.float64)
    distance = np.where(weight > 0, half_weight_mm * np.sqrt(1 / np.maximum(weight, 1e-9) - 1), np.nan)
    heat = HeatMap(
        vertices=subject.neutral, triangles=head.data.triangles, distance_mm=distance, T_head_world=subject.T_head_world
    )
    residual = subject.residual_mm
    curves = {"median": np.median(residual, 0).tolist(), "worst": residual.max(0).tolist()}
    return {
        "name": subject.subject,
        "expressions": len(subject.names),
        "images": heat_images(heat, LIMIT_MM),
        "curves": Markup(loss_curves({"distance, mm": curves})),
    }


def _rows(part: RegionalComponents, head: HeadGeometry) -> Iterator[dict[str, Any]]:
    moves = part.rigid_rms_mm(head)
    turns = np.degrees(np.linalg.norm(part.twists[:, :3], axis=1))
    for k in range(len(part.energy)):
        yield {
            "region": part.region,
            "number": k + 1,
            "flagged": bool(part.flagged[k]),
            "energy": part.energy[k],
            "values": (
                part.rigidity[k],
                part.rigid_fit_r2[k],
                part.label_independence[k],
                part.shared_motion[k],
                turns[k],
                moves[k],
            ),
        }
