"""The parts of a report that follow from a manifest alone, and their replacement when figures are added later."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from markupsafe import Markup

from registration.evaluate.names import LEVEL_TITLES, RESIDUALS
from registration.evaluate.verdict import judge
from registration.report.remarks import Assessed, format_mm, headline, remarks
from registration.report.templates import environment
from registration.storage.registration_folder import REPORT, read_manifest, update_figures
from registration.types import METRIC_TITLES

_STATISTICS = {"mean_mm": "mean", "median_mm": "median", "std_mm": "std", "p95_mm": "p95"}
_TILES = (
    ("scan_to_mesh", "face", "mean_mm", "scan to mesh, face, mean"),
    ("scan_to_mesh", "face", "median_mm", "scan to mesh, face, median"),
    ("scan_to_mesh", "face", "p95_mm", "scan to mesh, face, 95th percentile"),
    ("scan_to_mesh", "seen", "mean_mm", "scan to mesh, all visible parts, mean"),
    ("vertex_error", "face", "mean_mm", "vertex error against the ground truth, mean"),
    ("drift", "face", "mean_mm", "drift from the neutral, mean"),
)
_PARTS = ("summary", "distances")  # macros of figures.html; the page marks where they stand by comments


def figure_parts(registration: Assessed) -> dict[str, Markup]:
    """Return the parts of the page that follow from the figures, by name, each between two comments.

    Args:
        registration: or the manifest of one.
    """
    macros = environment().get_template("figures.html").module
    contents = {"summary": _summary(registration), "distances": _distances(registration.figures)}
    return {name: Markup(f"{_opening(name)}{getattr(macros, name)(contents[name])}{_closing(name)}") for name in _PARTS}


def refresh_report(folder: Path) -> None:
    """Judge a registration again from the figures of its manifest, and show them in its report.

    To be called after `update_figures`. A report without the parts, as of an older version, stays as it is.

    Args:
        folder: of the registration.

    Raises:
        InputError: no folder of ours.
    """
    manifest = read_manifest(folder)
    report = Path(folder) / REPORT
    page: str | None = None
    verdict = {"verdict": judge(manifest.status, manifest.figures).figure}
    if report.is_file():
        text = report.read_text(encoding="utf-8")
        for name, part in figure_parts(_Judged(manifest, verdict)).items():
            before, opening, rest = text.partition(_opening(name))
            _, closing, after = rest.partition(_closing(name))
            text = "".join((before, str(part), after)) if closing else text  # `+` would escape
        page = text
    update_figures(folder, verdict, report_html=page)


class _Judged:
    """What a manifest says, with another verdict."""

    def __init__(self, manifest: Assessed, verdict: Mapping[str, Any]):
        self.status, self.reason, self.seconds = manifest.status, manifest.reason, manifest.seconds
        self.figures = {**manifest.figures, **verdict}


def _opening(name: str) -> str:
    return f"<!-- {name} -->"


def _closing(name: str) -> str:
    return f"<!-- end of {name} -->"


def _summary(registration: Assessed) -> dict[str, Any]:
    figures = registration.figures
    verdict = figures.get("verdict") or judge(registration.status, figures).figure
    return {
        "status": registration.status,
        "level": verdict["level"],
        "title": LEVEL_TITLES[verdict["level"]],
        "reasons": verdict["reasons"],
        "headline": headline(registration),
        "remarks": remarks(registration),
        "tiles": _tiles(registration),
    }


def _tiles(registration: Assessed) -> list[tuple[str, str, str]]:
    figures, seconds = registration.figures, registration.seconds
    tiles = []
    for key, region, statistic, label in _TILES:
        value = figures.get(key, {}).get(region, {}).get(statistic)
        if value is not None:
            tiles.append((format_mm(value), "mm", label))
    if not tiles:
        overall = figures.get("residuals", {}).get("overall", {})
        tiles = [
            (f"{overall[name]:.1f}", kind.unit, f"{kind.title}: {kind.meaning}")
            for name, kind in RESIDUALS.items()
            if name in overall
        ]
    if seconds:
        total = sum(value for value in seconds.values() if value is not None)
        tiles.append((format_duration(total), "", f"in {len(seconds)} stages"))
    return tiles


def _distances(figures: Mapping[str, Any]) -> dict[str, Any]:
    rows = []
    for key, title in METRIC_TITLES.items():
        for region, row in figures.get(key, {}).items():
            note = ", ".join(
                f"{100 * row[field]:.1f} % excluded by {reason}"
                for field, reason in (("dropped_normals", "normals"), ("dropped_boundary", "the mesh's boundary"))
                if row.get(field)
            )
            if row.get("carried_mm") is not None:
                note = f"of these {format_mm(row['carried_mm'])} mm by the neutral's own distance from the truth"
            statistics = [format_mm(row[statistic]) for statistic in _STATISTICS]
            points = f"{row['points']:,}"
            rows.append({"title": title, "region": region, "points": points, "statistics": statistics, "note": note})
    return {"heads": ("points", *_STATISTICS.values()), "rows": rows}


def format_duration(seconds: float) -> str:
    """Return a duration in seconds, or in minutes and seconds."""
    if seconds < 10:
        return f"{seconds:.1f} s"
    return f"{seconds:.0f} s" if seconds < 120 else f"{int(seconds // 60)} min {seconds % 60:.0f} s"
