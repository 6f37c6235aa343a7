"""What every response gets and every request passes: the Host header's check, security headers, logs of requests."""

import logging
import time
from http import HTTPStatus
from urllib.parse import urlsplit

from starlette.datastructures import MutableHeaders
from starlette.requests import Request
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from registration.terminal import printable
from workflows.service.problems import Problem
from workflows.service.state import ServiceState

SECURITY_HEADERS = {
    "Content-Security-Policy": (
        "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data: blob:; connect-src 'self'; "
        "font-src 'self'; frame-src 'self'; form-action 'self'; base-uri 'none'; frame-ancestors 'self'"
    ),
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "SAMEORIGIN",
}
# Of reports and other pages among products: they run scripts of their own and show what others wrote, so that they get
# an origin of their own, without this site's session, and no source but themselves.
SANDBOX = {
    "Content-Security-Policy": (
        "sandbox allow-scripts allow-popups; default-src 'none'; script-src 'unsafe-inline' 'wasm-unsafe-eval' blob:; "
        "style-src 'unsafe-inline'; img-src data: blob:; font-src data:; media-src data: blob:; "
        "connect-src data: blob:; worker-src blob:; base-uri 'none'; form-action 'none'; frame-ancestors 'self'"
    ),
    "Cross-Origin-Opener-Policy": "unsafe-none",  # another one and a sandbox exclude each other in a tab of their own
}
_CHANGING = ("POST", "PUT", "PATCH", "DELETE")
log = logging.getLogger("gnmreg.service.requests")


class Guard:
    """ASGI middleware around the application."""

    def __init__(self, app: ASGIApp, state: ServiceState) -> None:
        self._app, self._state = app, state

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer one request."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        request, start, status = Request(scope), time.monotonic(), 0

        async def send_guarded(message: Message) -> None:
            nonlocal status
            if message["type"] == "http.response.start":
                status = message["status"]
                headers = MutableHeaders(scope=message)
                for name, value in SECURITY_HEADERS.items():
                    headers.setdefault(name, value)
                headers.setdefault("Cache-Control", "no-store")
            await send(message)

        if _host(request) not in self._state.settings.host_names:
            problem = Problem(
                HTTPStatus.MISDIRECTED_REQUEST,
                "The service has another name",
                where="Host",
                expected=", ".join(sorted(self._state.settings.host_names)),
                got=printable(request.headers.get("Host", ""))[:200],
                fix="start it with --name NAME",
            )
            await problem.response()(scope, receive, send_guarded)
        else:
            await self._app(scope, receive, send_guarded)
        self._note(request, status, time.monotonic() - start)

    def _note(self, request: Request, status: int, seconds: float) -> None:
        identity = getattr(request.state, "identity", None)
        who = identity.name if identity is not None else ""
        if request.method in _CHANGING and who:
            what = f"{request.method} {request.url.path}"
            self._state.audit.append(who=who, what=printable(what)[:500], status=status)
        log.info(
            "request",
            extra={
                "method": request.method,
                "path": printable(request.url.path)[:500],
                "status": status,
                "seconds": round(seconds, 4),
                "who": who,
            },
        )


def _host(request: Request) -> str | None:
    try:
        return (urlsplit(f"//{request.headers.get('Host', '')}").hostname or "").lower()
    except ValueError:
        return None
