"""Who may do what: every route by role, sessions, pages of other sites, failed tokens, what is kept of a token."""

import json
import re
import socket
import stat

import pytest
from fastapi.routing import RouteContext, iter_route_contexts

from registration.errors import InputError
from tests.workflows.service.conftest import open_service
from workflows.service.access import MAX_FAILURES
from workflows.service.app import OPEN, create_app, refuse_open_routes, role_of
from workflows.service.server import serve
from workflows.service.settings import ServiceSettings
from workflows.service.tokens import ROLES, Tokens


@pytest.fixture(scope="module")
def routes(service):
    app = create_app(service.state.settings)
    listed = list(iter_route_contexts(app.routes))
    return [(method, route) for route in listed for method in sorted(route.methods) if method != "HEAD"]


def place(route: RouteContext) -> str:
    """A path that the route takes, of things that do not exist."""
    return f"//{re.sub('{[^}]+}', 'nothing', route.path)[1:]}"


def test_every_route_without_a_token_is_refused(service, routes):
    asked = [(method, route) for method, route in routes if route.path not in OPEN]
    assert len(asked) > 8
    for method, route in asked:
        answer = service.request(method, place(route), role=None)
        assert answer.status in (401, 303), (method, route.path)
        if answer.status == 303:  # a page leads to the login
            assert answer.headers["location"].startswith("/login") and not route.include_in_schema


@pytest.mark.parametrize("role", ROLES)
def test_every_route_by_role(service, routes, role):
    for method, route in routes:
        needed = role_of(route)
        if route.path in OPEN or "events" in route.path:
            continue
        answer = service.request(method, place(route), role=role)
        allowed = needed in ("viewer", role)
        assert (answer.status != 403) == allowed, (method, route.path, needed, answer.body[:300])
        assert answer.status not in (401, 500)


def test_a_route_without_a_role_stops_the_application(service):
    app = create_app(service.state.settings)
    app.add_api_route("/new", lambda: None)
    with pytest.raises(RuntimeError, match="/new asks for no role"):
        refuse_open_routes(app)


@pytest.mark.parametrize("sent", ["", "Bearer", "Bearer x", "Basic abc", "Bearer gnmreg_00000000_x", "Bearer \u00e9"])
def test_what_is_no_token_is_refused(service, sent):
    answer = service.get("/runs", role=None, Authorization=sent.encode("latin-1").decode("latin-1"))
    assert answer.status in (401, 429)


def log_in(service, role="operator", **headers):
    body = f"token={service.tokens[role]}".encode()
    answer = service.request(
        "POST", "//login", body, role=None, Content_Type="application/x-www-form-urlencoded", **headers
    )
    return answer, answer.headers.get("set-cookie", "").partition(";")[0]


def test_a_session_reads_and_needs_the_csrf_token_to_change_anything(service):
    answer, cookie = log_in(service)
    assert answer.status == 303
    kept = answer.headers["set-cookie"].lower()
    assert "httponly" in kept and "samesite=strict" in kept
    assert service.get("/runs", role=None, Cookie=cookie).status == 200
    refused = service.post("/cancel", {"run": "none"}, role=None, Cookie=cookie)
    assert refused.status == 403 and "CSRF" in refused.json["detail"]
    csrf = service.state.access._session(cookie.partition("=")[2]).csrf
    assert service.post("/cancel", {"run": "none"}, role=None, Cookie=cookie, X_CSRF_Token=csrf).status == 404
    foreign = {"Origin": "http://evil.example", "X_CSRF_Token": csrf}
    assert service.post("/cancel", {"run": "none"}, role=None, Cookie=cookie, **foreign).status == 403
    altered = cookie[:-1] + ("0" if cookie[-1] != "0" else "1")
    assert service.get("/runs", role=None, Cookie=altered).status == 401


def test_streams_are_not_given_to_other_sites(service):
    _, cookie = log_in(service)
    answer = service.get("/events", role=None, Cookie=cookie, Origin="http://evil.example")
    assert answer.status == 403


def test_sessions_survive_a_restart_and_end_with_their_token(tmp_path):
    with open_service(tmp_path) as first:
        _, cookie = log_in(first)
    settings = first.state.settings
    with open_service(tmp_path / "other") as other:
        assert other.get("/runs", role=None, Cookie=cookie).status == 401  # another farm's key
    app = create_app(settings)
    access = app.state.service.access
    assert access._session(cookie.partition("=")[2]).name == "operator"
    Tokens(settings.state).revoke("operator")
    assert access._session(cookie.partition("=")[2]) is None


def test_a_login_link_works_once(service):
    token = service.state.tokens.find(service.tokens["viewer"])
    secret = service.state.access.login_link(token)
    assert service.get(f"//login?once={secret}", role=None).status == 303
    assert service.get(f"//login?once={secret}", role=None).status == 401


def test_failed_tokens_are_limited_and_valid_ones_are_not(tmp_path):
    with open_service(tmp_path) as service:
        statuses = [service.get("/runs", role=None, Authorization="Bearer no").status for _ in range(MAX_FAILURES + 3)]
        assert statuses[:MAX_FAILURES] == [401] * MAX_FAILURES and statuses[-1] == 429
        assert service.get("/runs").status == 200
        lines = [json.loads(line) for line in (tmp_path / "service" / "audit.jsonl").read_text().splitlines()]
        assert [line["what"] for line in lines] == ["refused token"] * MAX_FAILURES


def test_foreign_host_names_are_refused(service):
    assert service.get("/runs", Host="evil.example").status == 421
    assert service.get("/runs", Host="localhost").status == 200


def test_tokens_are_kept_as_hashes_for_their_owner_only(service):
    file = service.folder / "service" / "tokens.json"
    assert stat.S_IMODE(file.stat().st_mode) == 0o600 and stat.S_IMODE(file.parent.stat().st_mode) == 0o700
    kept = "".join(path.read_text("latin-1") for path in file.parent.rglob("*") if path.is_file())
    for token in service.tokens.values():
        assert token.rpartition("_")[2] not in kept


def test_tokens_expire_and_bad_ones_are_not_made(tmp_path):
    tokens = Tokens(tmp_path / "state")
    text = tokens.create("ann", ["viewer"], days=1e-9)
    assert tokens.find(text) is None
    with pytest.raises(InputError, match="The token exists"):
        tokens.create("ann", ["viewer"])
    for name, roles, days in (("", ["viewer"], 1), ("bob\n", ["viewer"], 1), ("bob", ["root"], 1), ("bob", [], 1)):
        with pytest.raises(InputError):
            tokens.create(name, roles, days=days)
    with pytest.raises(InputError):
        tokens.create("bob", ["viewer"], days=-1)
    with pytest.raises(InputError, match="There is no such token"):
        tokens.revoke("eve")


def test_nothing_listens_beyond_this_machine_without_a_token(tmp_path):
    settings = ServiceSettings(url=f"sqlite:///{tmp_path / 'queue.sqlite'}", folder=tmp_path, host="0.0.0.0")
    with pytest.raises(InputError, match="Nothing listens beyond this machine without a token"):
        serve(settings)
    assert list(tmp_path.iterdir()) == []


def test_a_port_in_use_is_refused(tmp_path):
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        settings = ServiceSettings(
            url=f"sqlite:///{tmp_path / 'queue.sqlite'}", folder=tmp_path, port=taken.getsockname()[1]
        )
        with pytest.raises(InputError, match="cannot listen"):
            serve(settings)


def test_requests_that_change_something_are_in_the_audit_log(service):
    service.post("/cancel", {"run": "audited"})
    lines = (service.folder / "service" / "audit.jsonl").read_text().splitlines()
    entries = [json.loads(line) for line in lines]
    assert any(e["who"] == "operator" and e["what"] == "POST /api/v1/cancel" and e["status"] == 404 for e in entries)


def test_every_answer_has_the_security_headers(service):
    for path in ("//healthz", "//login", "/runs"):
        headers = service.get(path).headers
        assert "script-src 'self'" in headers["content-security-policy"]
        assert "unsafe" not in headers["content-security-policy"]
        assert headers["x-content-type-options"] == "nosniff"
