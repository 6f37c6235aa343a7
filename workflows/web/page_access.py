"""Who may talk to a page: a browser on this machine that knows the page's token, from the page itself.

Any site that is open in a browser can send requests and open web sockets to a server of the loopback interface. So a
page answers only with its token, which is made anew at every start and is part of the URL that the command prints; the
browser keeps it in a cookie, with which the page loads its parts and connects.
"""

import secrets
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from http import HTTPStatus
from typing import Any
from urllib.parse import parse_qs, urlsplit

import websockets.asyncio.server
from websockets.asyncio.server import ServerConnection
from websockets.datastructures import Headers
from websockets.http11 import Request, Response

PARAMETER = "token"
_NAMES = ("127.0.0.1", "localhost", "::1")  # by which a browser, or a tunnel of ssh, reaches the loopback interface
_HEADERS = {
    "X-Frame-Options": "DENY",  # no other page can show this one and have the user click on it
    "Content-Security-Policy": "frame-ancestors 'none'",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Referrer-Policy": "no-referrer",  # the URL has the token
    "X-Content-Type-Options": "nosniff",
}
Answer = Callable[[ServerConnection, Request], Response | None]


class PageAccess:
    """The check of every request to one server, before a web socket opens or a file is sent."""

    def __init__(self) -> None:
        self.token = secrets.token_urlsafe(32)

    def refusal(self, request: Request, port: int) -> str:
        """Return why a request is refused; empty if it is not.

        Args:
            request: of HTTP, or of a web socket.
            port: of the server.
        """
        hosts, origins = request.headers.get_all("Host"), request.headers.get_all("Origin")
        if len(hosts) != 1 or _name(hosts[0]) not in _NAMES:  # a foreign name that was made to lead here
            return "the address must be 127.0.0.1 or localhost"
        if origins and origins != [f"http://{hosts[0]}"]:  # browsers send it with every web socket
            return "another page must not use this one"
        if not any(secrets.compare_digest(self.token.encode(), given.encode()) for given in _tokens(request, port)):
            return f"open the URL that the command printed, with its {PARAMETER}"
        return ""

    def answer(self, connection: ServerConnection, request: Request, inner: Answer) -> Response | None:
        """Refuse a request, or return what `inner` answers, with the token as a cookie."""
        port = connection.local_address[1]
        if reason := self.refusal(request, port):
            body = f"Refused: {reason}.\n".encode()
            headers = Headers({**_HEADERS, "Content-Type": "text/plain", "Content-Length": str(len(body))})
            return Response(HTTPStatus.FORBIDDEN, HTTPStatus.FORBIDDEN.phrase, headers, body)
        response = inner(connection, request)
        if response is not None:
            response.headers.update(_HEADERS)
            response.headers["Set-Cookie"] = f"{_cookie(port)}={self.token}; Path=/; HttpOnly; SameSite=Strict"
        return response


@contextmanager
def guarded_servers(access: PageAccess) -> Iterator[None]:
    """Put the check before every server of websockets that starts in this context.

    viser starts its server itself and takes no check of its own.

    Raises:
        RuntimeError: none was started: this release of viser would answer without the check.
    """
    original, started = websockets.asyncio.server.serve, []

    def serve(*arguments: Any, process_request: Answer, **settings: Any) -> Any:
        started.append(True)
        check = lambda connection, request: access.answer(connection, request, process_request)  # noqa: E731
        return original(*arguments, process_request=check, **settings)

    websockets.asyncio.server.serve = serve  # type: ignore[assignment, misc]
    try:
        yield
    finally:
        websockets.asyncio.server.serve = original  # type: ignore[misc]
    if not started:
        raise RuntimeError("this release of viser starts its server in another way: install the one of constraints.txt")


def _tokens(request: Request, port: int) -> Iterator[str]:
    """The tokens that a request gives, in its URL and in its cookies."""
    try:
        yield from parse_qs(request.path.partition("?")[2]).get(PARAMETER, [])
    except ValueError:
        pass
    for pair in ";".join(request.headers.get_all("Cookie")).split(";"):
        name, _, value = pair.strip().partition("=")
        if name == _cookie(port):
            yield value


def _cookie(port: int) -> str:
    """The name of the token's cookie: a browser gives one port's cookies to all ports of a host."""
    return f"gnmreg-{port}"


def _name(host: str) -> str | None:
    try:
        return urlsplit(f"//{host}").hostname
    except ValueError:
        return None
