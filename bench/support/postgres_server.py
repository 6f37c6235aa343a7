"""A temporary PostgreSQL server for tests and benchmarks, started in a folder as an unprivileged user."""

import os
import pwd
import shutil
import socket
import subprocess
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

PATTERNS = ("/usr/lib/postgresql/*/bin", "/usr/local/pgsql/bin")
USERS = ("postgres", "nobody")  # initdb refuses root


def programs() -> Path | None:
    """Return the folder with initdb and pg_ctl of the newest installed PostgreSQL, or None."""
    folders = [
        path for pattern in PATTERNS for path in Path("/").glob(pattern.lstrip("/")) if (path / "initdb").exists()
    ]
    on_path = shutil.which("initdb")
    return max(folders, key=str, default=Path(on_path).parent if on_path else None)


class Server:
    """A server on a free port of this machine."""

    def __init__(self, folder: Path) -> None:
        """Create and start the server in `folder`, which all users must be able to read (pytest's folders are not)."""
        installed = programs()
        assert installed is not None
        self._programs, self._data = installed, folder / "data"
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
        # No pipe, as the server that pg_ctl starts would keep it open.
        done = subprocess.run(command, user=self._user, group=self._user, cwd="/", stdout=subprocess.DEVNULL)
        assert done.returncode == 0, command


@contextmanager
def server() -> Iterator[Server]:
    with tempfile.TemporaryDirectory(prefix="gnmreg-postgres-") as name:
        Path(name).chmod(0o755)
        running = Server(Path(name) / "server")
        try:
            yield running
        finally:
            running.stop()


def _exists(user: str) -> bool:
    try:
        pwd.getpwnam(user)
    except KeyError:
        return False
    return True
