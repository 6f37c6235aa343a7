"""The HTML page of a coregistration: the running round, metrics, curves, and links to everything that exists."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from markupsafe import Markup

from registration.report.charts import ChartLine, line_charts
from workflows.pages.base import render
from workflows.records.coregistration import FIRST_MODEL, MANIFEST, PLAN, model_name
from workflows.records.round_files import HELD_OUT, RoundFiles

MISSING = "–"
_STEPS = ("stabilized expressions", "model", "evaluation")  # titles of products, in the order of the steps
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
    running = _running_round(record)
    return render(
        "coregistration.html",
        dataset=Path(plan["dataset"]).name,
        plan=plan,
        recipe=recipe if isinstance(recipe, str) else recipe["name"],
        lead=_lead(record),
        written=written,
        running="" if running is None else _progress(running, record, files),
        components=components,
        first_mm=record["generalization_mm"].get(FIRST_MODEL, {}).get(components),
        rounds=[_round(number, row, record, components) for number, row in enumerate(record["rounds"], 1)],
        curves=Markup(_curves(record)),
        measured_on=[*record["sources"].items(), *((name, "nothing: its neutral failed") for name in record["lost"])],
        failures=_failures(record["rounds"]),
        files=[_files(item, record, running) for item in files],
        each_report=sum(item.captures for item in files) <= _MAX_REPORTS,
        records=(MANIFEST, PLAN),
    )


def _lead(record: Mapping[str, Any]) -> str:
    verdict, stopped = record["verdict"], record.get("stopped", "")
    if stopped:
        return f"Stopped: {stopped}."
    if verdict is None:
        return "The first round is not done yet."
    return ("Continued: " if verdict["proceed"] else "Ended: ") + str(verdict["reason"]) + "."


def _running_round(record: Mapping[str, Any]) -> str | None:
    """The name of the round that is not done, None after the last one."""
    verdict = record["verdict"]
    return f"it{len(record['rounds']):02d}" if verdict is None or verdict["proceed"] else None


def _progress(running: str, record: Mapping[str, Any], files: Sequence[RoundFiles]) -> str:
    """What exists of the running round."""
    by_name = {item.name: item for item in files}
    held_out = by_name.get(HELD_OUT)
    sentences = []
    if record["plan"]["without_truth"] and not record["rounds"] and not (held_out and held_out.products):
        done = 0 if held_out is None else held_out.reported
        total = sum(len(record["plan"]["captures"][name]) for name in record["plan"]["without_truth"])
        sentences.append(f"Held-out subjects: {done} of {total} captures have a report.")
    item = by_name.get(running)
    if item is None:
        return " ".join([*sentences, f"Of round {running} there is nothing yet."])
    titles = [title for title, _ in item.products]
    missing = [title for title in _STEPS if title not in titles]
    sentences.append(f"Round {running}: {item.reported} of {item.captures} captures have a report;")
    present = [title for title in _STEPS if title in titles]
    sentences.append(f"done: {', '.join(present) or 'nothing else'}; not done: {', '.join(missing) or 'the verdict'}.")
    return " ".join(sentences)


def _files(item: RoundFiles, record: Mapping[str, Any], running: str | None) -> dict[str, Any]:
    """A group of links. Rounds that are neither in the record nor running were left by an earlier run."""
    known = {HELD_OUT, running, *(row["name"] for row in record["rounds"])}
    note = "" if item.name in known else "left by an earlier run"
    return {"files": item, "title": item.name.replace("_", " "), "note": note, "open": item.name == running}


def _round(number: int, row: Mapping[str, Any], record: Mapping[str, Any], components: str) -> list[str]:
    captures = [capture for subject in row["register"].values() for capture in subject.values()]
    failed = sum(not capture["usable"] for capture in captures)
    built, model = row["build"], model_name(number)
    metrics = [record[name].get(model, {}).get(components) for name in ("generalization_mm", "specificity_mm")]
    return [
        row["name"],
        *map(str, (len(captures) - failed, failed, len(built["rejected"]), built["components"])),
        f"{built['drift_mm']:.3f}",
        *(MISSING if value is None else f"{value:.3f}" for value in metrics),
    ]


def _curves(record: Mapping[str, Any]) -> str:
    panels: dict[str, list[ChartLine]] = {}
    for title, name in (("generalization, mm", "generalization_mm"), ("specificity, mm", "specificity_mm")):
        for model, curve in record[name].items():
            counts = [int(count) for count in curve]
            panels.setdefault(title, []).append(ChartLine(name=model, x=counts, y=list(curve.values())))
    return line_charts(panels, "components")


def _failures(rounds: list[Mapping[str, Any]]) -> list[tuple[str, str, str, str]]:
    """Return (round, registration, kind, reason) of all captures that no model uses."""
    rows = []
    for row in rounds:
        for subject, captures in row["register"].items():
            lost = [(name, capture["reason"]) for name, capture in captures.items() if not capture["usable"]]
            rows += [(row["name"], f"{subject}, {name}", "failed", reason) for name, reason in lost]
        rows += [(row["name"], outlier["name"], "left out", outlier["reason"]) for outlier in row["build"]["rejected"]]
    return rows
