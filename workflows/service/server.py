"""Start a service, and with workers a whole farm on this machine."""

import logging
import os
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import uvicorn

from registration.errors import InputError
from workflows.engine.database import redacted_url
from workflows.engine.log_output import FORMAT, JSON, configure_logging
from workflows.engine.process import migrate
from workflows.farm.local import FarmProcesses, LocalFarm, local_gpus
from workflows.service.app import create_app
from workflows.service.settings import CAPTURES, MODELS, RESULTS, ServiceSettings
from workflows.service.tokens import ROLES, Token, Tokens

GRACE_S = 5  # for requests in progress when the service stops
RESTART_S = 1.0  # between two looks at the farm's processes
LINK_NAME = "console"
log = logging.getLogger("gnmreg.service")


def serve(settings: ServiceSettings, *, workers: int = 0) -> None:
    """Answer requests until SIGTERM or SIGINT.

    Args:
        settings: of the service.
        workers: of a farm on this machine, with its coordinator; 0: the farm runs elsewhere.

    Raises:
        InputError: the address is in use or reaches beyond this machine without any token; the database cannot be used.
    """
    if not settings.is_loopback and not Tokens(settings.state).all():
        raise InputError(
            "Nothing listens beyond this machine without a token",
            where="--host",
            expected="127.0.0.1, or a farm with tokens",
            got=f"{settings.host} and no token",
            fix=f"gnmreg token create --folder {settings.folder} --name NAME --role operator",
        )
    for name in (CAPTURES, MODELS, RESULTS):
        (settings.folder / name).mkdir(parents=True, exist_ok=True)
    os.environ.setdefault(FORMAT, JSON)  # of this process and of the farm's
    configure_logging()
    migrate(settings.url)
    app = create_app(settings)
    server = _Server(app, settings)
    with _farm(settings, workers):
        server.run()


class _Server(uvicorn.Server):
    """Prints where it listens, with a link that logs in once."""

    def __init__(self, app: object, settings: ServiceSettings) -> None:
        config = uvicorn.Config(
            app,  # type: ignore[arg-type]
            host=settings.host,
            port=settings.port,
            log_config=None,
            access_log=False,
            server_header=False,
            proxy_headers=False,
            timeout_graceful_shutdown=GRACE_S,
        )
        super().__init__(config)
        self._settings, self._state = settings, app.state.service  # type: ignore[attr-defined]

    async def startup(self, sockets: list[object] | None = None) -> None:  # type: ignore[override]
        try:
            await super().startup(sockets)  # type: ignore[arg-type]
        except SystemExit:
            place = f"{self._settings.host}:{self._settings.port}"
            fix = "choose another one with --port"
            raise InputError(
                "The service cannot listen", where=place, expected="a free port", got="one in use", fix=fix
            ) from None
        port = self.servers[0].sockets[0].getsockname()[1]
        print(f"the queue is {redacted_url(self._settings.url)}")
        host = f"[{self._settings.host}]" if ":" in self._settings.host else self._settings.host
        address = f"http://{host}:{port}"
        link = ""
        if self._settings.is_loopback:
            link = f"/login?once={self._state.access.login_link(console_token(self._settings.folder))}"
        print(f"Open {address}{link}", flush=True)


def console_token(folder: Path) -> Token:
    """Return the token of the one who starts a service: its sessions end when another process starts one."""
    tokens = Tokens(ServiceSettings(url="", folder=folder).state)
    if any(token.name == LINK_NAME for token in tokens.all()):
        return next(token for token in tokens.all() if token.name == LINK_NAME)
    tokens.create(LINK_NAME, ROLES)
    return next(token for token in tokens.all() if token.name == LINK_NAME)


@contextmanager
def _farm(settings: ServiceSettings, workers: int) -> Iterator[None]:
    """A coordinator and workers, restarted when they end; none if `workers` is 0."""
    if not workers:
        yield
        return
    farm = LocalFarm(
        url=settings.url, folder=settings.folder, roots=settings.all_roots, workers=workers, gpus=local_gpus()
    )
    processes, stop = FarmProcesses(farm), threading.Event()

    def watch() -> None:  # children end with the thread that started them
        try:
            while not stop.is_set():
                processes.restart()
                stop.wait(RESTART_S)
        except InputError as error:
            log.error("a process of the farm could not start: %s", error.line)
        finally:
            processes.terminate()

    thread = threading.Thread(target=watch, name="farm")
    thread.start()
    try:
        yield
    finally:
        stop.set()
        thread.join()
