"""The HTML page of a coregistration: rounds, curves, the verdict, and links to the results of each round."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from markupsafe import Markup

from registration.report.charts import ChartLine, line_charts
from workflows.pages.base import render
from workflows.records.coregistration import FIRST_MODEL, model_name

MISSING = "–"


def render_coregistration_page(record: Mapping[str, Any]) -> str:
    """Return the page for the entries of `coregistration.json`; its links lead to files beside it."""
    plan, components = record["plan"], str(record["at"])
    recipe = plan["options"]["recipe"]
    return render(
        "coregistration.html",
        dataset=Path(plan["dataset"]).name,
        plan=plan,
        recipe=recipe if isinstance(recipe, str) else recipe["name"],
        lead=_lead(record["verdict"]),
        components=components,
        first_mm=record["generalization_mm"].get(FIRST_MODEL, {}).get(components),
        rounds=[_round(number, row, record, components) for number, row in enumerate(record["rounds"], 1)],
        curves=Markup(_curves(record)),
        measured_on=[*record["sources"].items(), *((name, "nothing: its neutral failed") for name in record["lost"])],
        failures=_failures(record["rounds"]),
    )


def _lead(verdict: Mapping[str, Any] | None) -> str:
    if verdict is None:
        return "The first round is not done yet."
    return ("Continued: " if verdict["proceed"] else "Ended: ") + str(verdict["reason"]) + "."


def _round(number: int, row: Mapping[str, Any], record: Mapping[str, Any], components: str) -> dict[str, Any]:
    captures = [capture for subject in row["register"].values() for capture in subject.values()]
    failed = sum(not capture["usable"] for capture in captures)
    built, model = row["build"], model_name(number)
    metrics = [record[name].get(model, {}).get(components) for name in ("generalization_mm", "specificity_mm")]
    cells = [
        row["name"],
        len(captures) - failed,
        failed,
        len(built["rejected"]),
        built["components"],
        f"{built['drift_mm']:.3f}",
        *(MISSING if value is None else f"{value:.3f}" for value in metrics),
    ]
    paths = ("model", "evaluation", *(["registrations/stabilized"] if row["stabilize"]["out"] else []))
    return {"name": row["name"], "cells": cells, "paths": paths}


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
