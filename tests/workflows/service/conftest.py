"""A service on a free port of this machine, with a token of each role, and requests to it."""

import http.client
import json
import threading
import time
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
import uvicorn

from workflows.engine.process import migrate
from workflows.service.app import create_app
from workflows.service.settings import CAPTURES, MODELS, RESULTS, ServiceSettings
from workflows.service.state import ServiceState
from workflows.service.tokens import ROLES, Tokens

API = "/api/v1"
Body = bytes | Mapping[str, Any] | Iterable[bytes] | None  # a mapping is sent as JSON


@dataclass(frozen=True)
class Answer:
    """A response, read to its end."""

    status: int
    headers: Mapping[str, str]  # names in lower case
    body: bytes

    @property
    def json(self) -> Any:
        return json.loads(self.body)

    @property
    def problem(self) -> Mapping[str, Any]:
        """The parts of a refusal; fails if the answer is none."""
        assert self.headers["content-type"] == "application/problem+json", (self.status, self.body[:500])
        assert self.json["status"] == self.status
        return self.json


@dataclass(frozen=True, kw_only=True)
class RunningService:
    """What tests know of a service that answers."""

    port: int
    folder: Path  # of the farm
    tokens: Mapping[str, str]  # role -> token
    state: ServiceState

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.port}"

    def request(
        self, method: str, path: str, body: Body = None, role: str | None = "operator", **headers: str
    ) -> Answer:
        """Send one request below /api/v1, or to a path that begins with "//" without that prefix.

        Args:
            method: of HTTP.
            path: with its query.
            body: a mapping is sent as JSON, an iterable in chunks.
            role: whose token is sent; None: none.
            headers: of the request, with "_" for "-".
        """
        sent = {name.replace("_", "-"): value for name, value in headers.items()}
        if role is not None:
            sent.setdefault("Authorization", f"Bearer {self.tokens[role]}")
        if isinstance(body, Mapping):
            body = json.dumps(body).encode()
            sent.setdefault("Content-Type", "application/json")
        connection = http.client.HTTPConnection("127.0.0.1", self.port, timeout=60)
        try:
            place = path[1:] if path.startswith("//") else f"{API}{path}"
            connection.request(method, place, body=body, headers=sent)
            response = connection.getresponse()
            names = {name.lower(): value for name, value in response.getheaders()}
            return Answer(response.status, names, response.read())
        finally:
            connection.close()

    def get(self, path: str, role: str | None = "viewer", **headers: str) -> Answer:
        return self.request("GET", path, role=role, **headers)

    def post(self, path: str, body: Body = None, role: str | None = "operator", **headers: str) -> Answer:
        return self.request("POST", path, body, role, **headers)


@contextmanager
def open_service(folder: Path, **settings: Any) -> Iterator[RunningService]:
    """Serve a new farm in a folder; `settings`: of `ServiceSettings`."""
    url = settings.pop("url", f"sqlite:///{folder / 'queue.sqlite'}")
    for name in (CAPTURES, MODELS, RESULTS):
        (folder / name).mkdir(parents=True, exist_ok=True)
    migrate(url)
    chosen = ServiceSettings(url=url, folder=folder, port=0, **{"poll_s": 0.2, **settings})
    tokens = {role: Tokens(chosen.state).create(role, [role]) for role in ROLES}
    app = create_app(chosen)
    server = uvicorn.Server(uvicorn.Config(app, host="127.0.0.1", port=0, log_level="warning", access_log=False))
    thread = threading.Thread(target=server.run, name="service")
    thread.start()
    try:
        until = time.monotonic() + 60.0
        while not server.started:
            assert thread.is_alive() and time.monotonic() < until, "the service did not start"
            time.sleep(0.02)
        port = server.servers[0].sockets[0].getsockname()[1]
        yield RunningService(port=port, folder=folder, tokens=tokens, state=app.state.service)
    finally:
        server.should_exit = True
        thread.join(30.0)


@pytest.fixture(scope="session")
def service(tmp_path_factory: pytest.TempPathFactory) -> Iterator[RunningService]:
    """One service for all tests that do not mind each other's runs: choose names that no other test has."""
    with open_service(tmp_path_factory.mktemp("service")) as running:
        yield running
