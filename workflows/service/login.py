"""Login with a token, or with the link that `gnmreg serve` prints; logout."""

from urllib.parse import parse_qs

from fastapi import APIRouter, Depends, Request
from starlette.responses import HTMLResponse, RedirectResponse, Response

from workflows.service.access import need
from workflows.service.problems import Problem
from workflows.service.rendering import render
from workflows.service.state import Service

router = APIRouter(tags=["login"], include_in_schema=False)
_MAX_FORM = 4096  # bytes
HOME = "/"


@router.get("/login")
def form(state: Service, request: Request, once: str = "", next: str = HOME) -> Response:
    """Show the form, or log in with a link's secret; `next`: the page to show then."""
    if not once:
        return _form(next)
    try:
        token = state.access.follow_link(request, once)
    except Problem as problem:
        return _form(next, str(problem), problem.status)
    response = RedirectResponse(_local(next), 303)
    state.access.login(response, token)
    return response


@router.post("/login")
async def log_in(state: Service, request: Request, next: str = HOME) -> Response:
    """Log in with the token of the form."""
    body = b""
    async for part in request.stream():
        body += part
        if len(body) > _MAX_FORM:
            return _form(next, "The form is too long", 413)
    given = parse_qs(body.decode("utf-8", "replace")).get("token", [""])[0].strip()
    try:
        token = state.access.check_token(request, given)
    except Problem as problem:
        return _form(next, str(problem), problem.status)
    response = RedirectResponse(_local(next), 303)
    state.access.login(response, token)
    state.audit.append(who=token.name, what="logged in")
    return response


@router.post("/logout", dependencies=[Depends(need("viewer"))])
def log_out(state: Service) -> Response:
    """End the session."""
    response = RedirectResponse("/login", 303)
    state.access.logout(response)
    return response


def _form(after: str, problem: str = "", status: int = 200) -> HTMLResponse:
    return HTMLResponse(render("login.html", problem=problem, after=_local(after)), status)


def _local(place: str) -> str:
    """A page of this service: a link must not lead elsewhere after the login."""
    plain = place.isprintable() and "\\" not in place
    return place if place.startswith("/") and not place.startswith("//") and plain else HOME
