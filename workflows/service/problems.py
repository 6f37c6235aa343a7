"""Errors of the API as problem details, application/problem+json [RFC 9457], with the parts of an `InputError`."""

import logging
from collections.abc import Callable
from http import HTTPStatus
from typing import Any

from fastapi import FastAPI, Request
from fastapi.encoders import jsonable_encoder
from fastapi.exceptions import RequestValidationError
from pydantic import BaseModel
from starlette.exceptions import HTTPException
from starlette.responses import JSONResponse, Response

from registration.errors import InputError
from registration.storage.files import DiskFull
from registration.terminal import printable
from workflows.ids import redact

MEDIA_TYPE = "application/problem+json"
log = logging.getLogger("gnmreg.service")


class ProblemDetails(BaseModel):
    """Why a request was refused."""

    type: str = "about:blank"
    title: str
    status: int
    detail: str
    where: str | None = None
    expected: str | None = None
    got: str | None = None
    fix: str | None = None
    more: list[str] | None = None  # other things that are wrong


class Problem(Exception):
    """A refusal of a request."""

    def __init__(
        self,
        status: HTTPStatus,
        detail: str,
        *,
        where: str | None = None,
        expected: str | None = None,
        got: str | None = None,
        fix: str | None = None,
        headers: dict[str, str] | None = None,
    ) -> None:
        super().__init__(detail)
        self.status, self.headers = status, headers or {}
        self.details = ProblemDetails(
            title=status.phrase, status=status, detail=detail, where=where, expected=expected, got=got, fix=fix
        )

    @classmethod
    def of_input(cls, error: InputError, status: HTTPStatus = HTTPStatus.UNPROCESSABLE_ENTITY) -> "Problem":
        """Return the refusal for an error of the input, with its parts."""
        return cls(
            status,
            redact(error.what),
            where=redact(error.where),
            expected=redact(error.expected),
            got=redact(error.got),
            fix=redact(error.fix),
        )

    @classmethod
    def missing(cls, kind: str, name: str, fix: str = "list what there is") -> "Problem":
        """Return the refusal of an id that does not exist."""
        shown = printable(name)[:200]
        return cls(HTTPStatus.NOT_FOUND, f"There is no such {kind}", where=kind, got=shown, fix=fix)

    def response(self) -> JSONResponse:
        """Return the response to send."""
        content = self.details.model_dump(exclude_none=True)
        return JSONResponse(content, self.status, headers=self.headers, media_type=MEDIA_TYPE)


RESPONSES: dict[int | str, dict[str, Any]] = {
    int(status): {"model": ProblemDetails, "description": text, "content": {MEDIA_TYPE: {}}}
    for status, text in {
        HTTPStatus.UNAUTHORIZED: "No valid token",
        HTTPStatus.FORBIDDEN: "The token lacks the role, or the request comes from another page",
        HTTPStatus.NOT_FOUND: "No such run, job, capture or artifact",
        HTTPStatus.CONFLICT: "The state of the queue does not allow it",
        HTTPStatus.REQUEST_ENTITY_TOO_LARGE: "The body, or what it unpacks to, is too large",
        HTTPStatus.UNPROCESSABLE_ENTITY: "Input that cannot be used",
        HTTPStatus.TOO_MANY_REQUESTS: "Too many failed tokens",
    }.items()
}


ForPeople = Callable[[Request, Problem], Response | None]


def install(app: FastAPI, for_people: ForPeople) -> None:
    """Have an application answer all errors with problem details. An unexpected error is logged, not shown.

    Args:
        app: the application.
        for_people: returns the page that a browser shows instead; None: the request is a program's.
    """

    def answer(request: Request, problem: Problem) -> Response:
        return for_people(request, problem) or problem.response()

    @app.exception_handler(Problem)
    async def refuse(request: Request, error: Problem) -> Response:
        return answer(request, error)

    @app.exception_handler(InputError)
    async def bad_input(request: Request, error: InputError) -> Response:
        return answer(request, Problem.of_input(error))

    @app.exception_handler(RequestValidationError)
    async def malformed(request: Request, error: RequestValidationError) -> Response:
        first = jsonable_encoder(error.errors())[0]
        where = printable(".".join(map(str, first["loc"])))[:200]
        problem = Problem(
            HTTPStatus.UNPROCESSABLE_ENTITY,
            "The request cannot be read",
            where=where,
            expected=printable(str(first["msg"]))[:400],
            got=printable(repr(first.get("input")))[:200],
            fix="see the API's description at /api/v1/openapi.json",
        )
        return answer(request, problem)

    @app.exception_handler(HTTPException)
    async def of_framework(request: Request, error: HTTPException) -> Response:
        headers = dict(error.headers or {})
        return answer(request, Problem(HTTPStatus(error.status_code), str(error.detail), headers=headers))

    @app.exception_handler(DiskFull)
    async def full(request: Request, error: DiskFull) -> Response:
        fix = "free space, then repeat"
        return answer(request, Problem(HTTPStatus.INSUFFICIENT_STORAGE, "The disk is full", fix=fix))

    @app.exception_handler(Exception)
    async def unexpected(request: Request, error: Exception) -> Response:
        log.error("%s %s failed", request.method, request.url.path, exc_info=error)
        status = HTTPStatus.INTERNAL_SERVER_ERROR
        return answer(request, Problem(status, "An error of the service; its log says more", fix="report it"))
