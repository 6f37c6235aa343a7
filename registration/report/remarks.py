"""A registration's result in sentences that a newcomer understands."""

from collections.abc import Mapping
from typing import Any, Protocol, runtime_checkable

from registration.evaluate.names import BEYOND_KEY, REVERSED_SKIN_MM2, SHARP_FOLD_DEG
from registration.types import METRIC_TITLES, Status

# Pair of the penetration audit -> what lies where, and where to look.
_PAIRS = {
    "lids in left eye": ("of the eyelids", "inside the left eyeball", "the left eye"),
    "lids in right eye": ("of the eyelids", "inside the right eyeball", "the right eye"),
    "lips in teeth": ("of the lips", "inside the teeth", "the mouth"),
    "lips in gums": ("of the lips", "inside the gums", "the mouth"),
    "lips in tongue": ("of the lips", "inside the tongue", "the mouth"),
    "tongue in teeth": ("of the tongue", "inside the teeth", "the mouth"),
    "tongue in gums": ("of the tongue", "inside the gums", "the mouth"),
    "tongue in skin": ("of the tongue", "inside the skin of the face", "the mouth"),
    "upper lip in lower lip": ("of the upper lip", "inside the lower lip", "the mouth"),
    "lower lip in upper lip": ("of the lower lip", "inside the upper lip", "the mouth"),
    "ears in skin": ("of an ear, or of the skin behind it,", "inside the other", "the ears"),
    "skin in itself": ("of the skin", "inside another part of the skin, as in a fold", "this place"),
}


@runtime_checkable
class Assessed(Protocol):
    """What a registration and the manifest of a registration folder share."""

    @property
    def status(self) -> Status: ...
    @property
    def reason(self) -> str: ...
    @property
    def figures(self) -> Mapping[str, Any]: ...
    @property
    def seconds(self) -> Mapping[str, float | None]: ...


def headline(registration: Assessed) -> str:
    """Return the result in one or two sentences."""
    opening = {
        "converged": "The registration converged",
        "stopped": "The registration was stopped before it converged",
        "failed": "The registration failed",
    }[registration.status]
    sentence = f"{opening}: {registration.reason}." if registration.reason else f"{opening}."
    face = registration.figures.get("scan_to_mesh", {}).get("face", {})
    if face.get("mean_mm") is None:
        why = registration.figures.get("unmeasured", {}).get("scan_to_mesh", "there is no scan of the face")
        return f"{sentence} Its distance from a scan is not measured: {why}."
    return (
        f"{sentence} On the face the scan lies {format_mm(face['mean_mm'])} mm from the mesh on average; "
        f"half of its points are within {format_mm(face['median_mm'])} mm and 95 % within "
        f"{format_mm(face['p95_mm'])} mm."
    )


def remarks(registration: Assessed) -> list[str]:
    """Return remarks besides the headline: views with low weights, excluded landmarks, parts inside one another."""
    figures = registration.figures
    lines = [str(warning) for warning in figures.get("warnings", [])]
    lines += [
        f"View {view} disagrees with the others and counts little: {why}. Look at its camera, image, mask and labels."
        for view, why in figures.get("views_not_trusted", {}).items()
    ]
    lines += [str(warning) for warning in figures.get("cameras", {}).get("warnings", [])]
    lines += [f"{note[:1].upper()}{note[1:]}." for note in figures.get("notes", [])]
    lines += _scan_in_fit(figures.get("scan_in_fit", {}))
    unmeasured = figures.get("unmeasured", {})
    lines += [
        f"{METRIC_TITLES[name]} is not measured: {unmeasured[name]}."
        for name in ("scan_to_mesh_by_area", "mesh_to_scan")
        if name in unmeasured
    ]
    lines += [
        _intersection(pair, row[BEYOND_KEY], row["max_excess_mm"], row.get("view"))
        for pair, row in figures.get("intersections", {}).get("pairs", {}).items()
        if row.get(BEYOND_KEY)
    ]
    lines += _folds(figures.get("folds", {}).get("places", {}))
    lines += [
        f"The skin of the {place} is turned inside out: a camera sees {row['area_mm2']:.1f} mm\u00b2 of its inner side"
        f"{_in_view(row.get('view'))}."
        for place, row in figures.get("reversed_skin", {}).get("places", {}).items()
        if row["area_mm2"] > REVERSED_SKIN_MM2
    ]
    return lines


def _folds(places: Mapping[str, Any]) -> list[str]:
    """A line that says where the skin is folded, if anywhere, and in which views to look at it."""
    words = [f"{row['edges']} of the {place}" + _in_view(row.get("view")) for place, row in places.items()]
    if not words:
        return []
    count = sum(row["edges"] for row in places.values())
    edges = "1 edge" if count == 1 else f"{count} edges"
    return [
        f"The skin turns back on itself by more than {SHARP_FOLD_DEG:g} degrees, as the model's does not, "
        f"at {edges}: {', '.join(words)}."
    ]


def _in_view(view: str | None) -> str:
    return f" (look at {view})" if view else ""


def _scan_in_fit(used: Mapping[str, Any]) -> list[str]:
    """A line that says what of the scan the fit has used, if anything."""
    views, share = used.get("normals"), used.get("surface")
    parts = [f"its normals in the {views} views without normal maps"] if views else []
    parts += [] if share is None else [f"its surface on {share:.0%} of the head's skin"]
    if not parts:
        return []
    return [f"The scan took part in the fit: {', '.join(parts)}. Its distances do not judge the fit independently."]


def _intersection(pair: str, count: int, worst_mm: float, view: str | None) -> str:
    part, place, target = _PAIRS.get(pair, (f"({pair})", "inside another part", "this place"))
    number = f"1 vertex {part} lies" if count == 1 else f"{count} vertices {part} lie"
    where = f": look at {target} in {view}" if view else ""
    return f"{number} {place}, worst {worst_mm:.1f} mm deeper than in the model itself{where}."


def format_mm(value: float | None) -> str:
    """Return a distance in millimetres with three significant digits or so."""
    return "–" if value is None else f"{value:.3f}" if value < 1 else f"{value:.2f}"
