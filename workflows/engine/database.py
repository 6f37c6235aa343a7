"""The queue's database: a SQLite file in WAL mode on one machine, or PostgreSQL for many. Only the URL differs."""

import sqlite3
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import sqlalchemy as sa

from registration.errors import InputError

FILE = "queue.sqlite"
SCHEMA = "dbos"  # on PostgreSQL
ENVIRONMENT = "GNMREG_DB"  # where a URL with a password belongs: command lines can be read by everyone
_NETWORK = ("nfs", "nfs4", "cifs", "smb3", "smbfs", "9p", "lustre", "ceph", "glusterfs", "fuse.sshfs", "beegfs", "gpfs")
_BUSY_S = 30.0


def default_url(folder: Path) -> str:
    """The SQLite database of a run's folder."""
    return f"sqlite:///{Path(folder).resolve() / FILE}"


def is_sqlite(url: str) -> bool:
    return url.startswith("sqlite")


def checked_url(url: str) -> str:
    """The URL in the form that all of us use.

    Raises:
        InputError: neither sqlite:///FILE nor postgresql://..., a SQLite file on a network disk, or no database's name.
    """
    try:
        parsed = sa.make_url(url)
    except (sa.exc.ArgumentError, ValueError):
        raise _refused(url, got="no URL") from None
    name = parsed.get_backend_name()
    if name not in ("sqlite", "postgresql") or not parsed.database or parsed.database == ":memory:":
        raise _refused(url, got=redacted_url(url))
    if name == "sqlite":
        file = Path(parsed.database).resolve()
        if (kind := _filesystem(file)) in _NETWORK:
            raise InputError(
                "SQLite cannot be used on a network disk",
                where=file,
                expected="a local disk: its locks do not hold across machines",
                got=kind,
                fix="put the queue on a local disk with --db, or use PostgreSQL",
            )
        return f"sqlite:///{file}"
    return parsed.set(drivername="postgresql+psycopg").render_as_string(hide_password=False)


def redacted_url(url: str) -> str:
    """The URL without its password."""
    try:
        return sa.make_url(url).render_as_string(hide_password=True)
    except (sa.exc.ArgumentError, ValueError):
        return "(no URL)"


def prepare(url: str) -> None:
    """Set what has to be set once: SQLite's folder and its write-ahead log, four times as fast as the default journal.

    Raises:
        InputError: the database cannot be reached or made.
    """
    try:
        if is_sqlite(url):
            file = Path(str(sa.make_url(url).database))
            file.parent.mkdir(parents=True, exist_ok=True)
            with sqlite3.connect(file, timeout=_BUSY_S) as connection:
                mode = connection.execute("PRAGMA journal_mode=WAL").fetchone()[0]
            if mode != "wal":
                raise OSError(f"its journal stays in the mode {mode!r}")
        else:
            with engine(url).connect() as connection:
                connection.execute(sa.text("SELECT 1"))
    except (OSError, sqlite3.Error, sa.exc.SQLAlchemyError) as error:
        first, *_ = str(getattr(error, "orig", error)).splitlines() or [""]
        raise InputError(
            "The queue's database cannot be used",
            where=redacted_url(url),
            expected="a SQLite file that can be written, or a PostgreSQL server that answers",
            got=first,
            fix="check the URL, the server and its password",
        ) from None


def require_queue(url: str) -> None:
    """Make sure that there is a queue at the URL. Raises InputError if there is none, or it cannot be reached."""
    got = ""
    if is_sqlite(url) and not Path(str(sa.make_url(url).database)).is_file():
        got = "no such file"  # connecting would make it
    else:
        made = engine(url, read_only=True)
        try:
            with made.connect() as connection:
                connection.execute(sa.text(f"SELECT 1 FROM {table(url, 'workflow_status')} LIMIT 1"))
        except sa.exc.SQLAlchemyError as error:
            got, *_ = str(getattr(error, "orig", error)).splitlines() or ["nothing"]
        finally:
            made.dispose()
    if got:
        raise InputError(
            "There is no queue",
            where=redacted_url(url),
            expected="a database that `gnmreg migrate` prepared",
            got=got,
            fix="check the URL, or run `gnmreg migrate`",
        )


def engine(url: str, *, read_only: bool = False) -> sa.Engine:
    """Our own connections, one at a time; with `read_only` the database itself refuses to write."""
    if not is_sqlite(url):
        options = "-c default_transaction_read_only=on" if read_only else ""
        arguments = {"connect_timeout": 30, "options": options}
        return sa.create_engine(url, poolclass=sa.pool.NullPool, connect_args=arguments)
    made = sa.create_engine(url, poolclass=sa.pool.NullPool, connect_args={"timeout": _BUSY_S})

    @sa.event.listens_for(made, "connect")
    def _set(connection: Any, _record: object) -> None:
        connection.isolation_level = "IMMEDIATE"  # a reader that becomes a writer may find the file busy for good
        connection.execute("PRAGMA foreign_keys=ON")
        if read_only:
            connection.execute("PRAGMA query_only=ON")

    return made


@contextmanager
def reading(url: str) -> Iterator[sa.Connection]:
    """A connection that can only read."""
    made = engine(url, read_only=True)
    try:
        with made.connect() as connection:
            yield connection
    finally:
        made.dispose()


def table(url: str, name: str) -> str:
    """The name of one of DBOS's tables in SQL."""
    return name if is_sqlite(url) else f"{SCHEMA}.{name}"


def below(run: str) -> dict[str, str]:
    """Parameters of `BELOW` for all jobs of a run, or of a part of it."""
    escaped = run.replace("\\", "\\\\").replace("%", "\\%").replace("_", "\\_")
    return {"run": run, "below": f"{escaped}/%"}


BELOW = "(workflow_uuid = :run OR workflow_uuid LIKE :below ESCAPE '\\')"


def _filesystem(file: Path) -> str:
    """The kind of filesystem that a path lies on, as /proc/mounts names it; empty where there is no such file."""
    best, kind = "", ""
    try:
        lines = Path("/proc/mounts").read_text().splitlines()
    except OSError:
        return ""
    for line in lines:
        _, point, found, *_ = line.split(" ")
        point = point.replace("\\040", " ")
        inside = str(file) == point or str(file).startswith(point.rstrip("/") + "/")
        if inside and len(point) >= len(best):
            best, kind = point, found
    return kind


def _refused(url: str, *, got: str) -> InputError:
    return InputError(
        "The queue's URL cannot be used",
        where=f"--db or {ENVIRONMENT}",
        expected="sqlite:////path/of/queue.sqlite or postgresql://user:password@host/database",
        got=got,
        fix="correct the URL",
    )
