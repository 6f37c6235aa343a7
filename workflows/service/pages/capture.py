"""The page of one job: pictures, figures beside the run's distribution, log, failure, what to do next."""

import math
import shlex
from array import array
from bisect import bisect_left, bisect_right
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

from fastapi import APIRouter, Depends, Request
from starlette.responses import Response

from registration.fit.recipes import RECIPES
from workflows.engine.jobs import GPU
from workflows.ids import redact
from workflows.records.headline import HEADLINES, WRONG, verdict_reasons
from workflows.service.access import need
from workflows.service.api.jobs import expression_name, find_entry
from workflows.service.board import Entry
from workflows.service.pages.base import LOOKS, look_of, page, text
from workflows.service.pages.files import report_url, row_of, thumbnail_url
from workflows.service.problems import Problem
from workflows.service.results import JobResults, arguments_of, results_of
from workflows.service.state import Service, ServiceState

router = APIRouter(include_in_schema=False, dependencies=[Depends(need("viewer"))])
BINS = 32  # of a distribution
MIN_OTHERS = 3  # captures with a figure before a distribution is drawn
_PARTS = ("what", "where", "expected", "got", "fix")


@router.get("/captures/{job:path}")
def capture_page(state: Service, request: Request, job: str) -> Response:
    """Show a job."""
    entry, row = find_entry(state, job), row_of(state, job)
    files, missing = _results(state, row)
    arguments = arguments_of(row)
    about = (row.result or {}).get("result")
    about = about.get("about", about) if isinstance(about, Mapping) else {}
    figures = about.get("figures") if isinstance(about, Mapping) else None
    shown = figures if isinstance(figures, Mapping) else {}
    failure = row.failure or {}
    parts = [(name, text(failure.get(name))) for name in _PARTS]
    recipe = _mapping(arguments.get("options")).get("recipe")
    version = entry.content_id or f"{entry.times.updated_ms:.0f}"
    return page(
        request,
        "capture.html",
        entry=entry,
        times=entry.times,
        look=look_of(entry.status) if entry.status in LOOKS else look_of(entry.times.state),
        name=expression_name(entry.id),
        run=entry.run,
        is_registration=entry.times.captures,
        is_of_batch="store" in arguments,
        failure=bool(failure),
        status=entry.status,
        reason="" if verdict_reasons(shown) else redact(entry.reason),
        rows=parts if any(value for name, value in parts if name != "fix") else [("reason", redact(entry.reason))],
        attempts=failure.get("attempts"),
        verdict=entry.level,
        wrong=WRONG,
        reasons=[redact(reason) for reason in verdict_reasons(shown)],
        figures=list(_figures(state, entry)),
        others=MIN_OTHERS,
        thumbnail=thumbnail_url(job, version) if files and files.thumbnail and files.thumbnail.is_file() else "",
        report=report_url(job, version) if files and files.report.is_file() else "",
        missing=missing,
        capture=redact(text(arguments.get("capture") or arguments.get("subject_dir"))),
        step=text(row.spec.get("step") or row.spec.get("flow")),
        recipe=recipe if isinstance(recipe, str) else text(_mapping(recipe).get("name")),
        recipes=sorted(RECIPES),
        queue=row.queue or GPU,
        command=_debug_command(state, job),
        worked_s=row.ended - row.started if row.ended and row.started else None,
    )


def _results(state: ServiceState, row: Any) -> tuple[JobResults | None, str]:
    """The files, and why they cannot be shown."""
    try:
        return results_of(state, row), ""
    except Problem as problem:
        details = problem.details
        return None, f"{details.detail}: expected {details.expected}, got {details.got}; {details.fix}"


def _debug_command(state: ServiceState, job: str) -> str:
    name = job.replace("/", "_")
    folder = shlex.quote(str(state.settings.folder))
    return f"gnmreg debug {shlex.quote(job)} --folder {folder} --out {shlex.quote(f'debug_{name}')} --view"


def _figures(state: ServiceState, entry: Entry) -> Iterator[dict[str, Any]]:
    """The figures of a registration, each with those of the others in its run."""
    if not len(entry.figures):
        return
    board = state.board.entries
    columns = state.board.derived.get(board, ("figures", entry.run), lambda: _columns(board.values(), entry.run))
    for column, headline in enumerate(HEADLINES):
        value, values = entry.figures[column], columns[column]
        if math.isnan(value):
            continue
        yield {
            "title": headline.title,
            "text": f"{value:.{headline.digits}f} {headline.unit}",
            "usual": f"{values[len(values) // 2]:.{headline.digits}f}" if values else "",
            "rank": bisect_right(values, value),
            "count": len(values),
            "strip": strip(values, value) if len(values) >= MIN_OTHERS else None,
        }


def _columns(entries: Iterable[Entry], run: str) -> list[Sequence[float]]:
    """The figures of all registrations of a run, sorted, without what was not measured."""
    rows = [entry.figures for entry in entries if entry.run == run and len(entry.figures)]
    return [array("f", sorted(value for value in column if value == value)) for column in zip(*rows, strict=True)]


def strip(values: Sequence[float], value: float) -> dict[str, Any]:
    """Return a histogram for an SVG of 200 x 44 units, and where one value is in it.

    Args:
        values: sorted.
        value: one of them; beyond the 98th percentile of the others it is drawn at the right edge.
    """
    low, high = values[0], values[min(len(values) - 1, int(0.98 * len(values)))]
    width = (high - low) or max(abs(high), 1e-9)
    edges = [bisect_left(values, low + width * k / BINS) for k in range(1, BINS)]
    counts = [end - start for start, end in zip([0, *edges], [*edges, len(values)], strict=True)]
    most = max(counts)
    bins = [(200 / BINS * k, 200 / BINS - 1, 30 * count / most) for k, count in enumerate(counts) if count]
    return {"bins": bins, "x": 200 * min(1.0, max(0.0, (value - low) / width)), "beyond": value > high}


def _mapping(value: Any) -> Mapping[str, Any]:
    return value if isinstance(value, Mapping) else {}
