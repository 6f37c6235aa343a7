"""What a registration says of its cranium: figures, a note for the user, and a file of each vertex' deviation."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from registration.cranium.auxiliary_model import FILE, CraniumModel
from registration.cranium.complete import CompletedCranium, CraniumSettings
from registration.cranium.conditional import patch_areas
from registration.frames import MM_PER_M
from registration.model.gnm_npz import GNMData
from registration.model.regions import cranium

VERTEX_FILE = "cranium.npz"  # in the registration's folder
NEUTRAL = "neutral"  # label of a capture whose face shows no expression
_NOTED_SHARE = 0.1  # of the cranium's area: less is always hidden, as behind the ears


def hidden_share(data: GNMData, confidence: Float[np.ndarray, "V"]) -> float:
    """Return the share of the cranium's area, in the template, whose confidence is below that of observed skin."""
    area = patch_areas(data.template_vertex_positions.astype(np.float64), data.triangles) * cranium(data)
    return float(area @ (confidence < CraniumSettings().min_confidence) / area.sum())


def cranium_figure(
    data: GNMData,
    confidence: Float[np.ndarray, "V"],
    model: CraniumModel | None,
    completed: CompletedCranium | None,
    moved: Float[np.ndarray, "V 3"] | None,
) -> dict[str, Any]:
    """Return the manifest's figure of the cranium.

    Args:
        data: the head model.
        confidence: of the vertices before the completion.
        model: the auxiliary model, if the registration had one.
        completed: the completed cranium; None: the fit's own.
        moved: how the completion displaced the vertices, metres.
    """
    share = round(hidden_share(data, confidence), 4)
    if model is None or completed is None or moved is None:
        return {"hidden_share": share, "completed_by": "fit"}
    deep = completed.hidden & cranium(data)
    return {
        "hidden_share": share,
        "completed_by": "model",
        "heads": model.heads,
        "rank": model.rank,
        "deviation_mm": _summary(completed.deviation, deep),
        "moved_mm": _summary(np.linalg.norm(moved, axis=1), deep),
    }


def cranium_note(figure: Mapping[str, Any], *, wanted: bool, neutral: bool) -> str | None:
    """Return the note on a hidden cranium that no auxiliary model completes; None: there is nothing to say.

    Args:
        figure: `cranium_figure`.
        wanted: whether the options ask for the auxiliary model.
        neutral: whether the fit started from the subject's neutral, whose cranium it keeps.
    """
    if not wanted or neutral or figure["completed_by"] == "model" or figure["hidden_share"] < _NOTED_SHARE:
        return None
    share = f"{100 * figure['hidden_share']:.0f} % of the cranium is hidden and left as the fit has it"
    return f"{share}: there is no auxiliary model {FILE} beside the head model (gnmreg model cranium)"


def write_cranium(completed: CompletedCranium, folder: Path) -> None:
    """Write `cranium.npz` into a registration's folder: hidden (V), weights (V) and deviation (V, metres)."""
    np.savez(
        folder / VERTEX_FILE,
        allow_pickle=False,
        hidden=completed.hidden,
        weights=completed.weights.astype(np.float32),
        deviation=completed.deviation.astype(np.float32),
    )


def _summary(distance: Float[np.ndarray, "V"], rows: Bool[np.ndarray, "V"]) -> dict[str, float]:
    values = distance[rows] * MM_PER_M
    return {"mean": round(float(values.mean()), 3), "p95": round(float(np.percentile(values, 95)), 3)}
