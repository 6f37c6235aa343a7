"""The HTML page of a coregistration: the running round, metrics, curves, and links to everything that exists."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from markupsafe import Markup

from registration.report.charts import ChartLine, line_charts
from workflows.pages.base import render
from workflows.pages.coregistration_rows import failures, lead, progress, round_row, running_round
from workflows.records.round_files import FIRST_MODEL, HELD_OUT, MANIFEST, PLAN, RoundFiles

_MAX_REPORTS = 5000  # that are linked one by one; more of them are on the subjects' pages


def render_coregistration_page(record: Mapping[str, Any], files: Sequence[RoundFiles], written: str) -> str:
    """Return the page.

    Args:
        record: entries of `coregistration.json`.
        files: what exists beside it; the links lead there.
        written: the time, UTC.
    """
    plan, components = record["plan"], str(record["at"])
    recipe = plan["options"]["recipe"]
    running = running_round(record)
    return render(
        "coregistration.html",
        dataset=Path(plan["dataset"]).name,
        plan=plan,
        recipe=recipe if isinstance(recipe, str) else recipe["name"],
        lead=lead(record),
        written=written,
        running="" if running is None else progress(running, record, files),
        components=components,
        first_mm=record["generalization_mm"].get(FIRST_MODEL, {}).get(components),
        rounds=[round_row(number, row, record, components) for number, row in enumerate(record["rounds"], 1)],
        curves=Markup(_curves(record)),
        measured_on=[*record["sources"].items(), *((name, "nothing: its neutral failed") for name in record["lost"])],
        failures=failures(record["rounds"]),
        files=[_files(item, record, running) for item in files],
        each_report=sum(item.captures for item in files) <= _MAX_REPORTS,
        records=(MANIFEST, PLAN),
    )


def _files(item: RoundFiles, record: Mapping[str, Any], running: str | None) -> dict[str, Any]:
    """A group of links. Rounds that are neither in the record nor running were left by an earlier run."""
    known = {HELD_OUT, running, *(row["name"] for row in record["rounds"])}
    note = "" if item.name in known else "left by an earlier run"
    return {"files": item, "title": item.name.replace("_", " "), "note": note, "open": item.name == running}


def _curves(record: Mapping[str, Any]) -> str:
    panels: dict[str, list[ChartLine]] = {}
    for title, name in (("generalization, mm", "generalization_mm"), ("specificity, mm", "specificity_mm")):
        for model, curve in record[name].items():
            counts = [int(count) for count in curve]
            panels.setdefault(title, []).append(ChartLine(name=model, x=counts, y=list(curve.values())))
    return line_charts(panels, "components")
