"""Requests that are repeated, because their answer was lost, get the first answer: the header Idempotency-Key.

<farm>/service/idempotency/<digest of token and key>.json     a request's digest, and its answer, for a day
"""

import hashlib
import json
import threading
import time
from collections.abc import Callable, Coroutine, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from http import HTTPStatus
from pathlib import Path
from typing import Annotated, Any

from fastapi import Header, Request, Response
from fastapi.routing import APIRoute
from starlette.concurrency import run_in_threadpool
from starlette.responses import JSONResponse

from registration.storage.records import Record
from workflows.service.problems import Problem

HEADER, REPEATED = "Idempotency-Key", "Idempotency-Replayed"
KEPT_S = 24 * 3600.0
MAX_KEY = 200  # letters
_TIDY_S = 600.0  # between two looks for old answers


@dataclass(frozen=True, kw_only=True)
class KeptAnswer(Record, kind="gnm-answer", title="kept answer", fix="delete it"):
    """The answer to a request."""

    request: str  # digest
    status: int
    location: str
    content: Any
    time: float  # seconds since 1970


class Answers:
    """The answers of one service."""

    def __init__(self, state: Path) -> None:
        """`state`: folder of the service's state."""
        self._folder = state / "idempotency"
        self._running: set[str] = set()
        self._lock = threading.Lock()
        self._tidied = 0.0

    @contextmanager
    def claim(self, name: str) -> Iterator[None]:
        """Hold a key. Raises Problem, 409, if another request holds it."""
        with self._lock:
            if name in self._running:
                fix = "wait for its answer, then repeat the request"
                raise Problem(HTTPStatus.CONFLICT, "A request with this key is in progress", where=HEADER, fix=fix)
            self._running.add(name)
        try:
            yield
        finally:
            self._running.discard(name)

    def find(self, name: str) -> KeptAnswer | None:
        """Return the answer of a key that is not too old; None if there is none."""
        file = self._folder / f"{name}.json"
        answer = KeptAnswer.read(file) if file.is_file() else None
        return None if answer is None or answer.time < time.time() - KEPT_S else answer

    def keep(self, name: str, answer: KeptAnswer) -> None:
        """Write an answer; old ones are deleted now and then."""
        self._folder.mkdir(parents=True, exist_ok=True, mode=0o700)
        answer.write(self._folder / f"{name}.json")
        if time.monotonic() > self._tidied + _TIDY_S or not self._tidied:
            self._tidied = time.monotonic()
            for file in self._folder.glob("*.json"):
                with suppress(OSError):
                    if file.stat().st_mtime < time.time() - KEPT_S:
                        file.unlink()


class RepeatableRoute(APIRoute):
    """A route whose requests may carry the header."""

    def get_route_handler(self) -> Callable[[Request], Coroutine[Any, Any, Response]]:
        """Return the handler: it keeps the answers of requests that succeed, by token and key."""
        answer_anew = super().get_route_handler()

        async def handle(request: Request) -> Response:
            key = request.headers.get(HEADER, "")
            if not key or len(key) > MAX_KEY:  # too long ones are refused by the header's description
                return await answer_anew(request)
            service = request.app.state.service
            identity = await run_in_threadpool(service.access.identify, request)
            name = _digest(identity.token.id, key)
            digest = _digest(request.method, request.url.path, request.url.query, _sha256(await request.body()))
            with service.answers.claim(name):
                kept = await run_in_threadpool(service.answers.find, name)
                if kept is not None and kept.request != digest:
                    raise Problem(
                        HTTPStatus.UNPROCESSABLE_ENTITY,
                        "The key belongs to another request",
                        where=HEADER,
                        expected="a new key for each request, or the very same request",
                        got="another request",
                        fix="choose another key",
                    )
                if kept is not None:
                    request.state.identity = identity  # for the audit log
                    headers = {"Location": kept.location, REPEATED: "true"}
                    return JSONResponse(kept.content, kept.status, headers=headers)
                response = await answer_anew(request)
                if response.status_code < HTTPStatus.MULTIPLE_CHOICES:
                    kept = _kept(digest, response)
                    await run_in_threadpool(service.answers.keep, name, kept)
                return response

        return handle


def idempotency_key(
    key: Annotated[
        str | None,
        Header(
            alias=HEADER,
            max_length=MAX_KEY,
            description="the same request with the same key is answered as the first one, for a day",
        ),
    ] = None,
) -> None:
    """Describe the header: a dependency of routes, which `RepeatableRoute` evaluates."""


def _kept(digest: str, response: Response) -> KeptAnswer:
    return KeptAnswer(
        request=digest,
        status=response.status_code,
        location=response.headers.get("Location", ""),
        content=json.loads(bytes(response.body)),
        time=time.time(),
    )


def _digest(*parts: str) -> str:
    return _sha256("\n".join(parts).encode("utf-8", "surrogateescape"))


def _sha256(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()
