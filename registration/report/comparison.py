"""One pass over all views of a fit: its registration rendered in each, for confidence, residuals and pictures."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from registration.evaluate.residuals import residual_figures, view_residuals
from registration.fit.confidence import vertex_confidence
from registration.fit.initialization import select_spread_views
from registration.fit.problem import FitProblem
from registration.report.inputs import ReportView, report_views, thumbnail
from registration.types import Rendered, Targets

_BATCH = 4  # views rendered together at the finest level
_SHOWN = 8  # views in full in the report
_SHOWN_SUSPECTS = 4  # of these, at most so many that are not trusted


@dataclass(frozen=True, kw_only=True)
class Comparison:
    """All views of a capture beside the rendered registration."""

    confidence: Float[np.ndarray, "V"]  # `fit.confidence`; 0 if the mesh is not finite
    residuals: Mapping[str, Any]  # `evaluate.residuals`
    class_names: tuple[str, ...]
    views: tuple[ReportView, ...]  # those that the report shows in full: suspects first, then spread around the head
    thumbnails: tuple[ReportView, ...]  # of all views, in the capture's order


def compare_views(problem: FitProblem) -> Comparison:
    """Render the registration once in every view, and collect what confidence, residuals and report need.

    Args:
        problem: after its last stage.
    """
    context, weights = problem.context, problem.view_weights
    count, vertices = context.view_count, problem.vertices().cpu().numpy()
    trusted = [view for view in range(count) if weights.geometry[view] > 0.5]
    others = sorted(set(range(count)) - set(trusted))
    names, cameras = context.pyramid[0].names, problem.pyramid[0].pixels.cameras
    suspects = [view for view in range(count) if names[view] in weights.notes][:_SHOWN_SUSPECTS]
    rest = [view for view in range(count) if view not in suspects]
    spread = select_spread_views([cameras[view] for view in rest], _SHOWN - len(suspects)) if rest else []
    shown = [*suspects, *(rest[index] for index in spread)]
    landmark_px = problem.landmark_px_by_view()
    residuals: dict[str, dict[str, float]] = {}
    views: dict[str, ReportView] = {}
    thumbnails: dict[str, ReportView] = {}

    def rendered(members: Sequence[int]) -> Iterator[tuple[Targets, Rendered]]:
        for first in range(0, len(members), _BATCH):
            batch_views = members[first : first + _BATCH]
            targets, rendering = problem.render_views(batch_views)
            depth_mm = problem.depth_mm_by_view(targets, rendering)
            residuals.update(view_residuals(targets, rendering, landmark_px[batch_views], depth_mm))
            for view, images in zip(batch_views, report_views(targets, rendering), strict=True):
                thumbnails[images.name] = thumbnail(images)
                if view in shown:
                    views[images.name] = images
            yield targets, rendering

    if np.isfinite(vertices).all():
        confidence = vertex_confidence(vertices, context.data.triangles, rendered(trusted))
    else:
        confidence = np.zeros(len(vertices), np.float32)
        others = [*trusted, *others]
    for _ in rendered(others):
        pass
    return Comparison(
        confidence=confidence,
        residuals=residual_figures({name: residuals[name] for name in names}, list(weights.notes)),
        class_names=context.pyramid[0].class_names,
        views=tuple(views[names[view]] for view in shown),
        thumbnails=tuple(thumbnails[name] for name in names),
    )
