"""What a fit's end is called, and why."""

from collections.abc import Collection, Mapping
from types import MappingProxyType

from registration.fit.problem import FitTrace
from registration.fit.view_weights import ViewErrors
from registration.types import Status

CONVERGED_MM = 0.05  # 95th percentile of vertex motion over the last tenth of the last stage
MAX_LANDMARK_PX = 3.0  # median residual at 512 px of head height
MAX_LANDMARK_SIGMAS = 3.0  # of landmarks whose spread is known: twice what is expected; then either limit suffices
_NAMED_VIEW_RATIO = 2  # times MAX_LANDMARK_PX: views with a larger error are named


def judge_fit(
    trace: FitTrace,
    landmark_px: Mapping[str, float],
    inside: Collection[str],
    errors: ViewErrors,
    deviations: Mapping[str, float] = MappingProxyType({}),
) -> tuple[Status, str]:
    """Return the status of a fit, and the reason.

    Args:
        trace: how the stages went.
        landmark_px: scheme -> median distance of triangulated landmarks from the mesh's, px at 512 px of head height.
        inside: schemes on teeth and tongue, which are reported but cause no failure: there are no offsets, and an
            expression cannot correct teeth that the neutral did not show.
        errors: of the views, to name those that disagree.
        deviations: scheme -> the same distance over the landmarks' standard deviation, where that is known: they may be
            as far off as it explains.
    """
    if trace.failure:
        return "failed", trace.failure
    off, explained = {}, []
    for name, px in sorted(landmark_px.items(), key=lambda item: -item[1]):
        if not px >= MAX_LANDMARK_PX:
            continue
        text = f"landmarks of scheme {name} are {px:.1f} px off in the median (limit {MAX_LANDMARK_PX}"
        sigmas = deviations.get(name)
        text += ")" if sigmas is None else f" or {MAX_LANDMARK_SIGMAS:g} standard deviations, here {sigmas:.1f})"
        if sigmas is not None and sigmas < MAX_LANDMARK_SIGMAS:
            explained.append(text)
        else:
            off[name] = text
    status: Status
    if off.keys() - inside:
        status, reasons = "failed", [reason for name, reason in off.items() if name not in inside]
    elif trace.motion_mm >= CONVERGED_MM:
        motion = f"vertices still moved by {trace.motion_mm:.3f} mm at the end (limit {CONVERGED_MM})"
        status, reasons = "stopped", [motion]
    else:
        motion = f"vertices moved by {trace.motion_mm:.3f} mm over the last tenth of the last stage"
        return "converged", "; ".join([motion, *off.values(), *explained])
    views = errors.disagreement(MAX_LANDMARK_PX * _NAMED_VIEW_RATIO)
    return status, "; ".join([*reasons, views] if views else reasons)
