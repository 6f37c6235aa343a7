"""The HTML page of a coregistration: rounds, curves, the verdict, and links to what each round left."""

from collections.abc import Mapping, Sequence
from html import escape
from pathlib import Path
from typing import Any
from urllib.parse import quote

from registration.report.charts import Line, number_curves
from registration.report.style import document
from workflows.pages.model import table
from workflows.records.coregistration import FIRST

_CSS = "td, th { padding-right: 14px; } .panel + .panel { margin-top: 16px; }"


def write_coregistration_page(told: Mapping[str, Any]) -> str:
    """From the entries of `coregistration.json`; links lead to what lies beside the page."""
    sections = (_rounds(told), _curves(told), _measured_on(told), _failures(told))
    body = f"{_header(told)}<main>{''.join(sections)}</main>"
    return document("Coregistration", body, css=_CSS, zooms=False)


def _header(told: Mapping[str, Any]) -> str:
    verdict, plan = told["verdict"], told["plan"]
    if verdict is None:
        lead = "The first round is not done yet."
    else:
        lead = ("It goes on: " if verdict["go_on"] else "It ended: ") + str(verdict["reason"]) + "."
    facts = (
        f"Recipe {plan['recipe']}, seed {plan['seed']}; {len(plan['split']['training'])} subjects to build from, "
        f"{len(plan['split']['held_out'])} held out {plan['split']['how']}."
    )
    return (
        '<header><div class="top"><div class="eyebrow">Coregistration</div>'
        f'<h1>{escape(Path(plan["dataset"]).name)}</h1><p class="lead">{escape(lead)}</p><p>{escape(facts)}</p>'
        "</div></header>"
    )


def _rounds(told: Mapping[str, Any]) -> str:
    heads = ("round", "registered", "failed", "left out", "identity", "drift, mm", "generalization, mm", "specificity")
    head = "".join(f"<th>{name}</th>" for name in (*heads, ""))
    at = str(told["at"])
    rows = "".join(_row(number, one, told, at) for number, one in enumerate(told["rounds"], 1))
    first = told["generalization_mm"].get(FIRST, {}).get(at)
    note = "" if first is None else f"<p>The first model: {first:.3f} mm with {at} components.</p>"
    return f'<section><h2>Rounds</h2>{note}<div class="panel"><table><tr>{head}</tr>{rows}</table></div></section>'


def _row(number: int, one: Mapping[str, Any], told: Mapping[str, Any], at: str) -> str:
    every = [row for rows in one["register"].values() for row in rows.values()]
    failed = sum(not row["usable"] for row in every)
    built, model = one["build"], f"model {number}"
    figures = [told[name].get(model, {}).get(at) for name in ("generalization_mm", "specificity_mm")]
    cells = [
        one["name"],
        len(every) - failed,
        failed,
        len(built["rejected"]),
        built["components"],
        f"{built['drift_mm']:.3f}",
        *("–" if figure is None else f"{figure:.3f}" for figure in figures),
    ]
    places = ("model", "evaluation", *(["registrations/stabilized"] if one["stabilize"]["out"] else []))
    links = " · ".join(
        f'<a href="{quote(one["name"])}/{place}/index.html">{place.split("/")[-1]}</a>' for place in places
    )
    return "<tr>" + "".join(f"<td>{escape(str(value))}</td>" for value in cells) + f"<td>{links}</td></tr>"


def _curves(told: Mapping[str, Any]) -> str:
    panels: dict[str, list[Line]] = {}
    for title, name in (("generalization, mm", "generalization_mm"), ("specificity, mm", "specificity_mm")):
        for model, curve in told[name].items():
            counts = [int(count) for count in curve]
            panels.setdefault(title, []).append(Line(name=model, x=counts, y=list(curve.values())))
    drawn = number_curves(panels, "components")
    return f'<section><h2>Curves</h2><div class="panel">{drawn}</div></section>' if drawn else ""


def _measured_on(told: Mapping[str, Any]) -> str:
    rows = [*told["sources"].items(), *((name, "nothing: its neutral failed") for name in told["lost"])]
    if not rows:
        return ""
    content = table(("held-out subject", "measured on"), rows)
    return f'<section><h2>Held out</h2><div class="panel">{content}</div></section>'


def _failures(told: Mapping[str, Any]) -> str:
    rows: list[Sequence[str]] = []
    for one in told["rounds"]:
        for subject, captures in one["register"].items():
            lost = [(name, row["reason"]) for name, row in captures.items() if not row["usable"]]
            rows += [(one["name"], f"{subject}, {name}", "failed", reason) for name, reason in lost]
        for spoiled in one["build"]["rejected"]:
            rows.append((one["name"], spoiled["name"], "left out", spoiled["reason"]))
    if not rows:
        return ""
    content = table(("round", "registration", "", "why"), rows)
    return f'<section><h2>What is in no model</h2><div class="panel">{content}</div></section>'
