"""Who is alive: a lock that the kernel, or PostgreSQL's kernel connection, holds for every process that takes jobs.

A heartbeat can be late because a step holds the interpreter's lock; a lock cannot. It is free exactly when its process
is gone, or, on PostgreSQL, when the connection broke. As a restart of the server breaks all of them at once, the
detector waits until a lock was free for a while and the server has been up for longer.
"""

import fcntl
import logging
import os
import threading
import time
import zlib
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import IO, Protocol

import sqlalchemy as sa

from registration.errors import InputError
from workflows.engine.database import engine, is_sqlite, reading, sqlite_file, table

log = logging.getLogger("gnmreg")

_CLASS = 0x676E6D  # "gnm": the first of the two numbers of our advisory locks


@dataclass(frozen=True, kw_only=True)
class Patience:
    """How long the detector waits before it takes a process for dead."""

    look_s: float = 2.0  # between two looks
    free_s: float = 15.0  # its lock must have been free that long
    up_s: float = 60.0  # and the server up that long


SQLITE_PATIENCE = Patience(free_s=2.0, up_s=0.0)  # a file's lock is lost with its process only


class Locks(Protocol):
    """The locks of one kind of database."""

    def take(self, name: str) -> bool:
        """Take the lock of this process and keep it; False if another process has it."""

    def keep(self) -> None:
        """Make sure that it is still held; raises if that cannot be told or done now."""

    def free(self, names: Iterable[str]) -> set[str]:
        """Those of the names whose lock nobody holds."""

    def up_s(self) -> float:
        """How long the database has been up."""


class FileLocks:
    """flock on files beside the SQLite database."""

    def __init__(self, url: str) -> None:
        database = sqlite_file(url)
        self._folder = database.with_name(f"{database.name}.locks")
        self._held: IO[str] | None = None

    def take(self, name: str) -> bool:
        self._folder.mkdir(parents=True, exist_ok=True)
        file = (self._folder / name).open("a")
        for _ in range(5):  # someone else's look takes it for a moment
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except OSError:
                time.sleep(0.05)
                continue
            self._held = file
            return True
        file.close()
        return False

    def keep(self) -> None:
        pass

    def free(self, names: Iterable[str]) -> set[str]:
        return {name for name in names if self._is_free(name)}

    def up_s(self) -> float:
        return float("inf")

    def _is_free(self, name: str) -> bool:
        try:
            descriptor = os.open(self._folder / os.path.basename(name), os.O_RDONLY)
        except FileNotFoundError:
            return True
        try:
            fcntl.flock(descriptor, fcntl.LOCK_SH | fcntl.LOCK_NB)
            return True
        except OSError:
            return False
        finally:
            os.close(descriptor)


class PostgresLocks:
    """Advisory locks on a connection of their own. A lost connection is opened again and the lock taken again."""

    def __init__(self, url: str) -> None:
        self._engine = engine(url)
        self._connection: sa.Connection | None = None
        self._name = ""

    def take(self, name: str) -> bool:
        self._name = name
        return self._taken()

    def keep(self) -> None:
        try:
            # Asked for by name: a connection that was silently opened again answers, but holds nothing.
            if self._connection is not None and self._name not in self.free([self._name]):
                return
        except sa.exc.SQLAlchemyError:
            self._drop()
        if not self._taken():
            raise ConnectionError(f"another process took the lock of {self._name}")

    def free(self, names: Iterable[str]) -> set[str]:
        keys = {name: _key(name) for name in names}
        query = sa.text(
            "SELECT l.objid::bigint FROM pg_locks l JOIN pg_database d ON d.oid = l.database "
            "WHERE l.locktype = 'advisory' AND l.classid = :class AND l.granted AND d.datname = current_database()"
        )
        held = {row[0] for row in self._open().execute(query, {"class": _CLASS})}
        return {name for name, key in keys.items() if key % 2**32 not in held}

    def up_s(self) -> float:
        query = sa.text("SELECT extract(epoch FROM now() - pg_postmaster_start_time())")
        return float(self._open().execute(query).scalar_one())

    def _taken(self) -> bool:
        query = sa.text("SELECT pg_try_advisory_lock(:class, :key)")
        return bool(self._open().execute(query, {"class": _CLASS, "key": _key(self._name)}).scalar_one())

    def _open(self) -> sa.Connection:
        if self._connection is None:
            fresh = self._engine.connect().execution_options(isolation_level="AUTOCOMMIT")
            # Without these the server would hold the lock of a machine that lost its power for two hours.
            for setting in ("tcp_keepalives_idle = 5", "tcp_keepalives_interval = 5", "tcp_keepalives_count = 2"):
                fresh.execute(sa.text(f"SET {setting}"))
            self._connection = fresh
        return self._connection

    def _drop(self) -> None:
        if self._connection is not None:
            try:
                self._connection.close()
            except sa.exc.SQLAlchemyError:
                pass
            self._connection = None


class Liveness:
    """This process' lock, and the thread that looks for processes whose lock is free."""

    def __init__(self, url: str, patience: Patience | None = None) -> None:
        self._url = url
        self._patience = patience or (SQLITE_PATIENCE if is_sqlite(url) else Patience())
        self._locks: Locks = FileLocks(url) if is_sqlite(url) else PostgresLocks(url)
        self._free_since: dict[str, float] = {}
        self._me = ""

    def join(self, names: Iterable[str]) -> str:
        """Take the lock of the first name that nobody has, and return that name: this process' executor id.

        Raises:
            InputError: all names are taken.
        """
        tried = []
        for name in names:
            if self._locks.take(name):
                self._me = name
                return name
            tried.append(name)
        raise InputError(
            "Another process has this place",
            where=", ".join(tried),
            expected="one worker for each GPU",
            got="a worker that is running there already",
            fix="stop that one, or choose another GPU",
        )

    def watch(self, version: str, recover: Callable[[str], None]) -> threading.Thread:
        """Look for the dead from now on and hand each one's executor id to `recover`."""
        thread = threading.Thread(target=self._watch, args=(version, recover), name="liveness", daemon=True)
        thread.start()
        return thread

    def _watch(self, version: str, recover: Callable[[str], None]) -> None:
        while True:
            time.sleep(self._patience.look_s)
            try:
                self._locks.keep()
                for name in self.dead(self._working(version), now=time.monotonic()):
                    log.warning("%s is gone: its jobs are given to others", name)
                    recover(name)
            except Exception as error:  # whatever it is, looking must go on: the server may be restarting
                self._free_since.clear()
                log.warning("cannot look for dead workers now: %s", str(error).splitlines()[0] if str(error) else error)

    def dead(self, names: Iterable[str], *, now: float) -> list[str]:
        """Those of the names that have been without a lock for long enough at the time `now` (monotonic, s)."""
        free = self._locks.free(name for name in names if name != self._me)
        self._free_since = {name: self._free_since.get(name, now) for name in free}
        ripe = [name for name, since in self._free_since.items() if now - since >= self._patience.free_s]
        return sorted(ripe) if ripe and self._locks.up_s() >= self._patience.up_s else []

    def _working(self, version: str) -> list[str]:
        """Executor ids of which jobs are under way."""
        query = (
            f"SELECT DISTINCT executor_id FROM {table(self._url, 'workflow_status')} "
            "WHERE status = 'PENDING' AND application_version = :version AND executor_id IS NOT NULL"
        )
        with reading(self._url) as ask:
            return [row[0] for row in ask(query, {"version": version})]


def _key(name: str) -> int:
    """The second number of a name's advisory lock, a signed 32 bit integer."""
    digest = zlib.crc32(name.encode())
    return digest - 2**32 if digest >= 2**31 else digest
