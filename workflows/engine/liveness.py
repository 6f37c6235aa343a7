"""Detection of dead processes by locks: every process that takes jobs holds a file lock, or a lock of PostgreSQL.

A heartbeat can be late because a step holds the interpreter's lock; a lock cannot. It is free exactly when its process
has ended or, on PostgreSQL, when its connection broke. A restart of the server breaks all connections at once, so a
process counts as dead only when its lock was free for some time and the server has been up for longer.
"""

import fcntl
import logging
import threading
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import IO, Protocol

import sqlalchemy as sa

from registration.errors import InputError
from workflows.engine.alive import HELD, LOCK_CLASS, is_free, lock_key, locks_folder
from workflows.engine.database import engine, is_sqlite, reading, table

log = logging.getLogger("gnmreg")


@dataclass(frozen=True, kw_only=True)
class LivenessTimeouts:
    """Times of the detector of dead processes, seconds."""

    poll_s: float = 2.0  # between two queries
    release_s: float = 15.0  # for which a dead process's lock must have been free
    uptime_s: float = 60.0  # for which the server must have been up


SQLITE_TIMEOUTS = LivenessTimeouts(release_s=2.0, uptime_s=0.0)  # only a process's end releases a file lock


class Locks(Protocol):
    """Locks of one kind of database."""

    def take(self, name: str) -> bool:
        """Take the lock of this process and keep it; return False if another process holds it."""

    def keep(self) -> None:
        """Check that the lock is still held, or take it again; raises if that is impossible now."""

    def free(self, names: Iterable[str]) -> set[str]:
        """Return those of the names whose lock no process holds."""

    def uptime_s(self) -> float:
        """Return for how long the database has been up, seconds."""


class FileLocks:
    """flock on files next to the SQLite database."""

    def __init__(self, url: str) -> None:
        self._folder = locks_folder(url)
        self._held: IO[str] | None = None

    def take(self, name: str) -> bool:
        self._folder.mkdir(parents=True, exist_ok=True)
        file = (self._folder / name).open("a")
        for _ in range(5):  # another process's query holds it for a moment
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
        return {name for name in names if is_free(self._folder, name)}

    def uptime_s(self) -> float:
        return float("inf")


class PostgresLocks:
    """Advisory locks on a separate connection. After a lost connection, the lock is taken again on a new one."""

    def __init__(self, url: str) -> None:
        self._engine = engine(url)
        self._connection: sa.Connection | None = None
        self._name = ""

    def take(self, name: str) -> bool:
        self._name = name
        return self._taken()

    def keep(self) -> None:
        try:
            # By name: a connection that was silently reopened answers, but holds no lock.
            if self._connection is not None and self._name not in self.free([self._name]):
                return
        except sa.exc.SQLAlchemyError:
            self._drop()
        if not self._taken():
            raise ConnectionError(f"another process took the lock of {self._name}")

    def free(self, names: Iterable[str]) -> set[str]:
        held = {row[0] for row in self._open().execute(sa.text(HELD), {"class": LOCK_CLASS})}
        return {name for name in names if lock_key(name) % 2**32 not in held}

    def uptime_s(self) -> float:
        query = sa.text("SELECT extract(epoch FROM now() - pg_postmaster_start_time())")
        return float(self._open().execute(query).scalar_one())

    def _taken(self) -> bool:
        query = sa.text("SELECT pg_try_advisory_lock(:class, :key)")
        return bool(self._open().execute(query, {"class": LOCK_CLASS, "key": lock_key(self._name)}).scalar_one())

    def _open(self) -> sa.Connection:
        if self._connection is None:
            connection = self._engine.connect().execution_options(isolation_level="AUTOCOMMIT")
            # Without these, the server would hold the lock of a machine that lost power for two hours.
            for setting in ("tcp_keepalives_idle = 5", "tcp_keepalives_interval = 5", "tcp_keepalives_count = 2"):
                connection.execute(sa.text(f"SET {setting}"))
            self._connection = connection
        return self._connection

    def _drop(self) -> None:
        if self._connection is not None:
            try:
                self._connection.close()
            except sa.exc.SQLAlchemyError:
                pass
            self._connection = None


class Liveness:
    """The lock of this process, and the thread that searches for processes whose lock is free."""

    def __init__(self, url: str, timeouts: LivenessTimeouts | None = None) -> None:
        self._url = url
        self._patience = timeouts or (SQLITE_TIMEOUTS if is_sqlite(url) else LivenessTimeouts())
        self._locks: Locks = FileLocks(url) if is_sqlite(url) else PostgresLocks(url)
        self._free_since: dict[str, float] = {}
        self._own_name = ""

    def join(self, names: Iterable[str]) -> str:
        """Take the lock of the first free name, and return that name: the executor id of this process.

        Raises:
            InputError: all names are taken.
        """
        taken = []
        for name in names:
            if self._locks.take(name):
                self._own_name = name
                return name
            taken.append(name)
        raise InputError(
            "Another process has this executor id",
            where=", ".join(taken),
            expected="one worker for each GPU",
            got="a worker that is already running there",
            fix="stop it, or choose another GPU",
        )

    def watch(self, version: str, recover: Callable[[str], None]) -> threading.Thread:
        """Start the search for dead processes; `recover` is called with each one's executor id."""
        thread = threading.Thread(target=self._watch, args=(version, recover), name="liveness", daemon=True)
        thread.start()
        return thread

    def _watch(self, version: str, recover: Callable[[str], None]) -> None:
        while True:
            time.sleep(self._patience.poll_s)
            try:
                self._locks.keep()
                for name in self.dead(self._working(version), now=time.monotonic()):
                    log.warning("%s is dead: its jobs are given to others", name)
                    recover(name)
            except Exception as error:  # continue after any error: the server may be restarting
                self._free_since.clear()
                first, *_ = str(error).splitlines() or [repr(error)]
                log.warning("cannot search for dead workers now: %s", first)

    def dead(self, names: Iterable[str], *, now: float) -> list[str]:
        """Return those of the names whose lock has been free for long enough at the time `now` (monotonic, s)."""
        free = self._locks.free(name for name in names if name != self._own_name)
        self._free_since = {name: self._free_since.get(name, now) for name in free}
        dead = [name for name, since in self._free_since.items() if now - since >= self._patience.release_s]
        return sorted(dead) if dead and self._locks.uptime_s() >= self._patience.uptime_s else []

    def _working(self, version: str) -> list[str]:
        """Executor ids that have running jobs."""
        query = (
            f"SELECT DISTINCT executor_id FROM {table(self._url, 'workflow_status')} "
            "WHERE status = 'PENDING' AND application_version = :version AND executor_id IS NOT NULL"
        )
        with reading(self._url) as ask:
            return [row[0] for row in ask(query, {"version": version})]
