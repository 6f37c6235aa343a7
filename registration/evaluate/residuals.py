"""Residuals of a registration in its own images: what can be measured without a scan (docs/formats.md, "Figures")."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float
from torch import Tensor

from registration.capture.pixels import undistort_landmarks
from registration.capture.triangulation import MIN_CONFIDENCE
from registration.evaluate.names import RESIDUALS, ResidualKind
from registration.fit.view_weights import view_errors
from registration.frames import MM_PER_M, linear_to_srgb
from registration.types import Capture, Rendered, Targets

FAR_MM = 10.0  # of a landmark from the mesh's, across the line of sight: more than detectors err, and than fits miss
FAR_SPREADS = 3.0  # of a landmark whose spread is known: it must exceed both
_LEVELS = 255  # of 8 bit sRGB


def view_residuals(
    targets: Targets,
    rendered: Rendered,
    landmark_px: Float[Tensor, "N"],
    depth_mm: Float[Tensor, "N"] | None = None,
) -> dict[str, dict[str, float]]:
    """Measure the residuals in each view of a batch.

    Args:
        targets: of the views.
        rendered: the registration at the pixels of `targets`, with the colours of each camera's exposure.
        landmark_px: median distance of each view's landmarks, px at 512 px of head height; NaN without landmarks.
        depth_mm: median distance of each view's depth map from the mesh; NaN without one, None: no view has any.

    Returns:
        View -> key of `RESIDUALS` -> value; a kind that cannot be measured in a view is missing there.
    """
    outline_px = view_errors(rendered, targets, landmark_px).outline_px
    count = len(targets.names)
    means = {
        "silhouette_px": outline_px.cpu().numpy(),
        "normals_deg": _by_view(*_normal_angles(targets, rendered), targets, np.median),
        "depth_mm": np.full(count, np.nan) if depth_mm is None else depth_mm.cpu().numpy(),
        "colour_levels": _by_view(*_colour_differences(targets, rendered), targets, np.mean),
        "labels_percent": _by_view(*_wrong_labels(targets, rendered), targets, np.mean),
        "landmarks_px": landmark_px.cpu().numpy(),
    }
    return {
        targets.names[view]: {kind: float(values[view]) for kind, values in means.items() if np.isfinite(values[view])}
        for view in range(count)
    }


def far_landmarks(capture: Capture, landmarks: Mapping[str, Float[np.ndarray, "L 3"]]) -> dict[str, float] | None:
    """Return how many of a capture's landmarks lie far from those of the mesh.

    A robust fit leaves out landmarks that contradict the others, so that medians do not show them.

    Args:
        capture: its landmarks of confidence above `MIN_CONFIDENCE` count, view by view.
        landmarks: scheme -> points on the registered mesh, metres, in the world of the capture.

    Returns:
        `percent` of the counted ones that are more than `FAR_MM` and `FAR_SPREADS` standard deviations away, across the
        line of sight at the depth of the mesh's point; `counted`. None: no landmark counts.
    """
    far, total = 0, 0
    for view in capture.views:
        for name in sorted(set(view.landmarks) & set(landmarks)):
            pixels = undistort_landmarks(view, name)
            shown_px, depth_m = view.camera.project(landmarks[name])
            mm_per_px = MM_PER_M * depth_m / view.camera.intrinsics[0, 0]
            distance_mm = np.linalg.norm(pixels[:, :2] - shown_px, axis=1) * mm_per_px
            spread_px = np.nan_to_num(view.landmark_spread_px.get(name, np.zeros(len(pixels))))
            counts = (pixels[:, 2] > MIN_CONFIDENCE) & np.isfinite(distance_mm)
            limit_mm = np.maximum(FAR_MM, FAR_SPREADS * spread_px * mm_per_px)
            total += int(counts.sum())
            far += int((counts & (distance_mm > limit_mm)).sum())
    return {"percent": 100.0 * far / total, "counted": total} if total else None


def residual_figures(views: Mapping[str, Mapping[str, float]], not_trusted: Sequence[str] = ()) -> dict[str, Any]:
    """Return the manifest's figure of the residuals: of each view, and overall.

    Args:
        views: as `view_residuals` returns them, of all views.
        not_trusted: views that do not count overall.

    Returns:
        `views`, and `overall`: the median over the trusted views of each kind that any of them has.
    """
    trusted = [values for name, values in views.items() if name not in not_trusted]
    known = {kind: [values[kind] for values in trusted if kind in values] for kind in RESIDUALS}
    overall = {kind: float(np.median(values)) for kind, values in known.items() if values}
    return {"overall": overall, "views": {name: dict(values) for name, values in views.items()}}


def residual_rows(figure: Mapping[str, Any]) -> list[tuple[ResidualKind, float | None, float, str]]:
    """Return the rows of a table of residuals: kind, overall value, worst value and its view.

    Args:
        figure: of a manifest, as `residual_figures` returns it; kinds that no view has are omitted.
    """
    rows, views = [], figure.get("views", {})
    for name, kind in RESIDUALS.items():
        known = {view: values[name] for view, values in views.items() if name in values}
        if known:
            worst = max(known, key=lambda view: known[view])
            rows.append((kind, figure.get("overall", {}).get(name), known[worst], worst))
    return rows


def _by_view(values: np.ndarray, counts: np.ndarray, targets: Targets, statistic: Any) -> Float[np.ndarray, "N"]:
    """The statistic of the pixels that count, view by view; NaN without any."""
    view = targets.pixels.view.cpu().numpy()
    members = (values[counts & (view == number)] for number in range(len(targets.names)))
    return np.array([statistic(part) if len(part) else np.nan for part in members])


def _array(values: Tensor) -> np.ndarray:
    return values.detach().float().cpu().numpy()


def _normal_angles(targets: Targets, rendered: Rendered) -> tuple[np.ndarray, np.ndarray]:
    """Degrees at each pixel, and where both normals are known."""
    target, shown = _array(targets.normals), _array(rendered.normals)
    lengths = np.linalg.norm(target, axis=-1) * np.linalg.norm(shown, axis=-1)
    counts = (_array(targets.normal_weight) > 0) & (lengths > 0)
    cosine = (target * shown).sum(-1) / np.where(counts, lengths, 1)
    return np.degrees(np.arccos(np.clip(cosine, -1, 1))), counts


def _colour_differences(targets: Targets, rendered: Rendered) -> tuple[np.ndarray, np.ndarray]:
    """Mean over the channels at each pixel, in sRGB levels, and where colours are compared."""
    target, shown = linear_to_srgb(_array(targets.rgb)), linear_to_srgb(_array(rendered.rgb))
    counts = (_array(targets.rgb_weight) > 0) & (_array(rendered.mask) > 0.5)
    return _LEVELS * np.abs(target - shown).mean(-1), counts


def _wrong_labels(targets: Targets, rendered: Rendered) -> tuple[np.ndarray, np.ndarray]:
    """100 at each pixel of another label and 0 elsewhere, and where labels are compared."""
    target, shown = _array(targets.classes), _array(rendered.classes)
    if not target.shape[-1]:
        return np.zeros(len(target)), np.zeros(len(target), bool)
    counts = (_array(targets.class_weight) > 0) & (target.max(-1) > 0.5) & (_array(rendered.mask) > 0.5)
    return 100.0 * (target.argmax(-1) != shown.argmax(-1)), counts
