"""What all pages share: the frame, names of states for people, formats of times and counts."""

import time
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any
from urllib.parse import quote, urlencode

from fastapi import Request
from starlette.responses import HTMLResponse, Response

from workflows.farm import status
from workflows.ids import redact
from workflows.service.access import Identity
from workflows.service.board import Entry
from workflows.service.problems import Problem
from workflows.service.rendering import render

LOGIN = "/login"


@dataclass(frozen=True)
class Look:
    """How a state is shown: with a sign and a word besides the colour."""

    colour: str  # class of service.css
    sign: str


_GOOD, _WARN, _BAD, _BUSY, _QUIET = "good", "warn", "bad", "busy", "quiet"
LOOKS = {
    "converged": Look(_GOOD, "✓"),
    "done": Look(_GOOD, "✓"),
    "good": Look(_GOOD, "✓"),
    "accept": Look(_GOOD, "✓"),
    "accepted": Look(_GOOD, "✓"),
    "stopped": Look(_WARN, "◐"),
    "look": Look(_WARN, "?"),
    "interrupted": Look(_WARN, "‖"),
    "wrong": Look(_BAD, "✕"),
    "reject": Look(_BAD, "✕"),
    "rejected": Look(_BAD, "✕"),
    "running": Look(_BUSY, "▶"),
    "waiting": Look(_QUIET, "…"),
    "cancelled": Look(_QUIET, "⊘"),
}
OTHER = Look(_BAD, "✕")  # whatever a failure is called


def look_of(word: str) -> Look:
    """Return how a state, a status or a level is shown."""
    return LOOKS.get(word, OTHER)


def look_of_entry(entry: Entry) -> Look:
    """Return how a job is shown: by its state, or by its registration's status and verdict."""
    if entry.level in ("look", "wrong") and entry.times.state == "done":
        return LOOKS[entry.level]
    return look_of(entry.status if entry.status in LOOKS else entry.times.state)


def page(request: Request, template: str, *, code: int = 200, **context: Any) -> HTMLResponse:
    """Return a page of a person who is logged in.

    Args:
        request: which `need` let through.
        template: a file of `templates` that extends base.html.
        code: status of HTTP.
        context: values of the template; all of them are escaped.
    """
    identity: Identity | None = getattr(request.state, "identity", None)
    frame = {
        "who": identity,
        "here": request.url.path,
        "operator": identity is not None and identity.allows("operator"),
        "reviewer": identity is not None and identity.allows("reviewer"),
        "look_of": look_of,
        "job_url": job_url,
        "ago": ago,
        "clock": clock,
        "duration": duration,
    }
    return HTMLResponse(render(template, **frame, **context), code)


def for_people(request: Request, problem: Problem) -> Response | None:
    """Return a problem as a page, or the way to the login; None for a program, which reads problem details."""
    accepts = "text/html" in request.headers.get("Accept", "")
    if not accepts or request.method not in ("GET", "HEAD") or request.url.path.startswith("/api/"):
        return None
    if problem.status == 401:
        place = request.url.path + (f"?{request.url.query}" if request.url.query else "")
        after = f"?{urlencode({'next': place})}" if place != "/" else ""
        return HTMLResponse("", 303, headers={"Location": LOGIN + after})
    return page(request, "problem.html", code=problem.status, details=problem.details)


def job_url(identity: str) -> str:
    """Return the address of a job's page."""
    return f"/captures/{quote(identity)}"


def clock(seconds: float | None) -> str:
    """Return a time, UTC."""
    return "–" if seconds is None else datetime.fromtimestamp(seconds, UTC).strftime("%Y-%m-%d %H:%M:%S UTC")


def ago(seconds: float | None) -> str:
    """Return how long ago a time was."""
    return "–" if seconds is None else f"{duration(time.time() - seconds)} ago"


def duration(seconds: float | None) -> str:
    """Return a duration in words; a dash for none."""
    return "–" if seconds is None else status.duration(max(seconds, 0.0))


def text(value: Any) -> str:
    """Return a value from a queue's row as text without passwords; empty for none."""
    return "" if value is None else redact(str(value))
