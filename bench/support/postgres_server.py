"""A real PostgreSQL server for tests: made in a folder, started as an ordinary user, thrown away."""

import os
import pwd
import shutil
import socket
import subprocess
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

PLACES = ("/usr/lib/postgresql/*/bin", "/usr/local/pgsql/bin")
USERS = ("postgres", "nobody")  # initdb refuses root


def programs() -> Path | None:
    """The folder of initdb and pg_ctl of the newest PostgreSQL here, or None."""
    found = [path for place in PLACES for path in Path("/").glob(place.lstrip("/")) if (path / "initdb").exists()]
    on_path = shutil.which("initdb")
    return max(found, key=str, default=Path(on_path).parent if on_path else None)


class Server:
    """One server on a free port of this machine."""

    def __init__(self, folder: Path) -> None:
        """`folder` is to be readable by all: what pytest makes is not."""
        found = programs()
        assert found is not None
        self._programs, self._data = found, folder / "data"
        self._user = next((u for u in USERS if _exists(u)), None) if os.getuid() == 0 else None
        folder.mkdir(parents=True, exist_ok=True)
        if self._user:
            shutil.chown(folder, self._user)
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            self._port = free.getsockname()[1]
        self._run("initdb", "-D", str(self._data), "-U", "farm", "--auth=trust", "--no-sync", "-E", "UTF8")
        self.start()
        self._run("createdb", "-h", "127.0.0.1", "-p", str(self._port), "-U", "farm", "queue")

    @property
    def url(self) -> str:
        return f"postgresql://farm:secret@127.0.0.1:{self._port}/queue"

    def start(self) -> None:
        options = f"-p {self._port} -c listen_addresses=127.0.0.1 -c unix_socket_directories=''"
        log = str(self._data / "server.log")
        self._run("pg_ctl", "-D", str(self._data), "-l", log, "-o", options, "-w", "start")

    def stop(self) -> None:
        self._run("pg_ctl", "-D", str(self._data), "-m", "immediate", "-w", "stop")

    def _run(self, program: str, *arguments: str) -> None:
        command = [str(self._programs / program), *arguments]
        # Not a pipe: the server that pg_ctl starts would keep it open.
        done = subprocess.run(command, user=self._user, group=self._user, cwd="/", stdout=subprocess.DEVNULL)
        assert done.returncode == 0, command


@contextmanager
def server() -> Iterator[Server]:
    with tempfile.TemporaryDirectory(prefix="gnmreg-postgres-") as name:
        Path(name).chmod(0o755)
        made = Server(Path(name) / "server")
        try:
            yield made
        finally:
            made.stop()


def _exists(user: str) -> bool:
    try:
        pwd.getpwnam(user)
    except KeyError:
        return False
    return True
