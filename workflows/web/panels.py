"""The panels beside a page's scene, as HTML with inline drawings."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from registration.report.templates import environment
from registration.stabilize.components import HeadGeometry, RegionalComponents
from registration.stabilize.decisions import CorrectionEffect
from registration.stabilize.edge_stretch import EdgeStretch
from registration.stabilize.stabilized_folder import StoredComponents
from workflows.web.review_state import WorkItem

_BINS, _MAX_SIGMAS = 24, 3.0  # of a histogram: bars, and its range to either side
_MAX_LABELS = 24
_TOP = 10


def work_list(items: Sequence[WorkItem], here: tuple[str, int]) -> str:
    """What has been reviewed, and the components with their decisions; `here` is displayed."""
    flagged = [item for item in items if item.flagged]
    counts = (
        f"reviewed {sum(item.decided for item in items)} of {len(items)}",
        f"of the flagged {sum(item.decided for item in flagged)} of {len(flagged)}" if flagged else "none is flagged",
    )
    return _panel("work_list", items=items, counts=counts, here=here)


def about(part: RegionalComponents, k: int, action: str, head: HeadGeometry, stretch: EdgeStretch) -> str:
    """Scores of a component, its rigid part in degrees and mm, and what dropping it would do to the mesh."""
    turn = np.degrees(np.linalg.norm(part.twists[k, :3]))
    moves = part.rigid_rms_mm(head)[k]
    rows = (
        ("energy of the region", f"{100 * part.energy[k]:.1f} %"),
        ("rigid score", f"{part.rigidity[k]:.2f}"),
        ("rigid fit, R²", f"{part.rigid_fit_r2[k]:.2f}"),
        ("size of the rigid motion", f"{part.rigid_size_ratio[k]:.2f}"),
        ("label independence", f"{part.label_independence[k]:.2f}"),
        ("motion shared by nose and neck", f"{part.shared_motion[k]:.2f}"),
        ("rigid motion, one σ", f"{turn:.2f}° \N{NO-BREAK SPACE} {moves:.2f} mm"),
        ("edge stretch if dropped", f"{stretch.ratio:.2f} times, {stretch.longer_mm:.1f} mm longer"),
        ("edges torn if dropped", f"{len(stretch.torn)}"),
    )
    tears = action == "drop" and stretch.tears
    return _panel("about", rows=rows, flagged=bool(part.flagged[k]), action=action, tears=tears)


def colour_bar(limit_mm: float, title: str) -> str:
    """The colour scale of distances up to `limit_mm`."""
    return _panel("colour_bar", limit_mm=limit_mm, title=title)


def error(effect: CorrectionEffect, unsaved: int, tearing: Sequence[WorkItem]) -> str:
    """How the rebuilt set differs from the one that it was built from, with the current decisions."""
    rows = (
        ("difference after reconstruction, rms", f"{effect.rms_mm:.3f} mm"),
        ("largest difference of a sample", f"{effect.max_mm:.2f} mm"),
        ("rotation of heads, rms", f"{effect.rotation_deg:.3f}°"),
        ("decisions not saved", f"{unsaved}"),
    )
    return _panel("error", rows=rows, tearing=tearing)


def histogram(coefficients: Float[np.ndarray, "S"], labels: Sequence[str]) -> str:
    """A row of bars for each label: head motion is similar for all, an expression differs from the others."""
    edges = np.linspace(-_MAX_SIGMAS, _MAX_SIGMAS, _BINS + 1)
    names, index = np.unique(np.asarray(labels), return_inverse=True)
    order = np.argsort([coefficients[index == k].mean() for k in range(len(names))])[::-1]
    lines = []
    for k in order[:_MAX_LABELS]:
        counts, _ = np.histogram(np.clip(coefficients[index == k], -_MAX_SIGMAS, _MAX_SIGMAS), edges)
        lines.append((str(names[k]), (counts / counts.max()).tolist()))
    return _panel("histogram", lines=lines, more=len(names) - len(lines), bins=_BINS, sigmas=2 * _MAX_SIGMAS)


def strongest(part: RegionalComponents, k: int, stored: StoredComponents) -> str:
    """The ten samples with the largest coefficients of a component."""
    coefficients = part.coefficients[:, k]
    rows = [
        (stored.subjects[s], stored.names[s], f"{coefficients[s]:+.1f} σ")
        for s in np.argsort(-np.abs(coefficients))[:_TOP]
    ]
    return _panel("strongest", rows=rows)


def _panel(name: str, **values: Any) -> str:
    """Call a macro of `templates/panels.html`; all values are escaped."""
    macros = environment("workflows.web").get_template("panels.html").module
    return str(getattr(macros, name)(**values))
