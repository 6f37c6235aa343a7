"""Who may send a request: tokens in headers, sessions in cookies, roles, and pages of the service itself only.

Programs send `Authorization: Bearer TOKEN`. People log in with a token, and their browser keeps a signed cookie, which
no script reads and no other site sends. Requests of a session that change something need the session's CSRF token, too.
"""

import hashlib
import hmac
import os
import secrets
import tempfile
import threading
import time
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from http import HTTPStatus
from pathlib import Path
from urllib.parse import urlsplit

from fastapi import Request, Response

from workflows.service.audit import AuditLog
from workflows.service.problems import Problem
from workflows.service.settings import ServiceSettings
from workflows.service.tokens import Role, Token, Tokens

COOKIE = "gnmreg_session"
CSRF_HEADER = "X-CSRF-Token"
SESSION_S = 12 * 3600.0
MAX_FAILURES, WINDOW_S = 10, 60.0  # failed tokens of one client
ONCE_S = 300.0  # for which a login link is valid
_KEY = "session_key"
_SAFE = ("GET", "HEAD", "OPTIONS")


@dataclass(frozen=True, kw_only=True)
class Identity:
    """Who sends a request."""

    token: Token
    csrf: str = ""  # of the session; empty for a program

    @property
    def name(self) -> str:
        """Name of the token."""
        return self.token.name

    def allows(self, role: Role) -> bool:
        """Return whether the identity has a role."""
        return self.token.allows(role)


class Access:
    """The check of every request to one service."""

    def __init__(self, settings: ServiceSettings, tokens: Tokens, audit: AuditLog) -> None:
        """Create the key of sessions, or read it: sessions survive a restart."""
        self.settings, self.tokens, self.audit = settings, tokens, audit
        self._key = _session_key(settings.state / _KEY)
        self._failures: dict[str, deque[float]] = {}
        self._links: dict[str, tuple[float, Token]] = {}
        self._lock = threading.Lock()

    def identify(self, request: Request) -> Identity:
        """Return who sends a request.

        Raises:
            Problem: 401 without a valid token or session; 403 if a page of another site sends it, or without CSRF
                token; 429 after too many failed tokens.
        """
        scheme, _, given = request.headers.get("Authorization", "").partition(" ")
        if scheme.lower() == "bearer":
            return Identity(token=self.check_token(request, given.strip()))
        identity = self._session(request.cookies.get(COOKIE, ""))
        if identity is None:
            raise Problem(
                HTTPStatus.UNAUTHORIZED,
                "A token is needed",
                expected="Authorization: Bearer TOKEN, or a session of /login",
                got="neither",
                fix="create one with `gnmreg token create`",
                headers={"WWW-Authenticate": "Bearer"},
            )
        self._check_page(request, identity)
        return identity

    def check_token(self, request: Request, text: str) -> Token:
        """Return a valid token. Raises Problem: 401, or 429 after too many failures of this client."""
        token = self.tokens.find(text)
        if token is None:
            self._note_failure(request, "refused token")
            fix = "create one with `gnmreg token create`; revoked and expired ones are refused"
            headers = {"WWW-Authenticate": "Bearer"}
            raise Problem(HTTPStatus.UNAUTHORIZED, "The token is not valid", fix=fix, headers=headers)
        return token

    def login(self, response: Response, token: Token) -> None:
        """Give a browser a session of a token."""
        value = f"{token.id}.{int(time.time() + SESSION_S)}.{secrets.token_hex(8)}"
        signed = f"{value}.{self._sign('session', value)}"
        response.set_cookie(
            COOKIE,
            signed,
            max_age=int(SESSION_S),
            httponly=True,
            samesite="strict",
            secure=self.settings.https,
        )

    def logout(self, response: Response) -> None:
        """Have a browser forget its session."""
        response.delete_cookie(COOKIE, httponly=True, samesite="strict", secure=self.settings.https)

    def login_link(self, token: Token) -> str:
        """Return the secret of a link that logs in once, within five minutes."""
        secret = secrets.token_urlsafe(32)
        with self._lock:
            self._links[secret] = time.monotonic() + ONCE_S, token
        return secret

    def follow_link(self, request: Request, secret: str) -> Token:
        """Return the token of a link, which is then used up. Raises Problem."""
        with self._lock:
            until, token = self._links.pop(secret, (0.0, None))
        if token is None or time.monotonic() > until:
            self._note_failure(request, "refused login link")
            fix = "log in with a token"
            raise Problem(HTTPStatus.UNAUTHORIZED, "The link was used, or is too old", fix=fix)
        return token

    def _session(self, cookie: str) -> Identity | None:
        value, _, signature = cookie.rpartition(".")
        if not value or not hmac.compare_digest(signature.encode(), self._sign("session", value).encode()):
            return None
        identity, expires, _ = value.split(".")
        token = self.tokens.by_id(identity)
        if token is None or float(expires) < time.time():
            return None
        return Identity(token=token, csrf=self._sign("csrf", value))

    def _check_page(self, request: Request, identity: Identity) -> None:
        """Refuse requests that pages of other sites send with the browser's cookie."""
        origin, site = request.headers.get("Origin"), request.headers.get("Sec-Fetch-Site", "none")
        foreign = site not in ("same-origin", "none") or (origin is not None and not _same_host(origin, request))
        if foreign and (request.method not in _SAFE or request.headers.get("Sec-Fetch-Mode") != "navigate"):
            raise Problem(HTTPStatus.FORBIDDEN, "The request comes from another site", got=origin or site)
        given = request.headers.get(CSRF_HEADER, "")
        if request.method not in _SAFE and not hmac.compare_digest(given.encode(), identity.csrf.encode()):
            raise Problem(
                HTTPStatus.FORBIDDEN,
                "The request lacks the session's CSRF token",
                where=CSRF_HEADER,
                expected="the token of the page",
                got="another" if given else "none",
                fix="reload the page",
            )

    def _note_failure(self, request: Request, what: str) -> None:
        """Count a failed token. Raises Problem, 429, after too many of one client; valid tokens are never delayed."""
        client, now = request.client.host if request.client else "unknown", time.monotonic()
        with self._lock:
            recent = {name: times for name, times in self._failures.items() if times[-1] > now - WINDOW_S}
            failures = recent.setdefault(client, deque(maxlen=MAX_FAILURES + 1))
            failures.append(now)
            self._failures = recent
            full = len(failures) > MAX_FAILURES and failures[0] > now - WINDOW_S
        if full:
            raise Problem(
                HTTPStatus.TOO_MANY_REQUESTS,
                "Too many failed tokens",
                fix=f"wait {WINDOW_S:.0f} seconds",
                headers={"Retry-After": f"{WINDOW_S:.0f}"},
            )
        self.audit.append(who=client, what=what)

    def _sign(self, purpose: str, value: str) -> str:
        return hmac.new(self._key, f"{purpose}:{value}".encode(), hashlib.sha256).hexdigest()


def need(role: Role) -> Callable[[Request], Identity]:
    """Return a dependency of a route that lets only tokens with a role through, and yields who sends the request."""

    def check(request: Request) -> Identity:
        identity: Identity = request.app.state.service.access.identify(request)
        request.state.identity = identity
        if not identity.allows(role):
            raise Problem(
                HTTPStatus.FORBIDDEN,
                "The token lacks a role",
                where=f"token {identity.name}",
                expected=role,
                got=", ".join(identity.token.roles),
                fix=f"create one with `gnmreg token create --role {role}`",
            )
        return identity

    check.role = role  # type: ignore[attr-defined]  # read by the check that no route is open
    return check


def _same_host(origin: str, request: Request) -> bool:
    try:
        return urlsplit(origin).netloc.lower() == request.headers.get("Host", "").lower()
    except ValueError:
        return False


def _session_key(file: Path) -> bytes:
    """The key in a file that only its owner reads; created at the first start, complete at once."""
    file.parent.mkdir(parents=True, exist_ok=True, mode=0o700)
    if not file.exists():
        with tempfile.NamedTemporaryFile(dir=file.parent) as temporary:  # with mode 0600
            temporary.write(secrets.token_bytes(32))
            temporary.flush()
            with suppress(FileExistsError):
                os.link(temporary.name, file)
    return file.read_bytes()
