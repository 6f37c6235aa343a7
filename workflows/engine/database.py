"""The queue's database: a SQLite file in WAL mode on one machine, or PostgreSQL for many. Only the URL differs.

Questions go straight to the drivers: `gnmreg status` shall not wait for SQLAlchemy, which only what writes imports.
"""

import re
import sqlite3
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import urlsplit

from registration.errors import InputError

if TYPE_CHECKING:
    import sqlalchemy as sa

FILE = "queue.sqlite"
SCHEMA = "dbos"  # on PostgreSQL
ENVIRONMENT = "GNMREG_DB"  # where a URL with a password belongs: command lines can be read by everyone
_NETWORK = ("nfs", "nfs4", "cifs", "smb3", "smbfs", "9p", "lustre", "ceph", "glusterfs", "fuse.sshfs", "beegfs", "gpfs")
_BUSY_S, _CONNECT_S = 30.0, 30
_READ_ONLY = "-c default_transaction_read_only=on"
Ask = Callable[[str, Mapping[str, Any]], list[Any]]  # SQL with :names, their values (lists after IN) -> rows


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
        parts = urlsplit(url)
        kind, database = parts.scheme.partition("+")[0], parts.path[1:]
    except ValueError:
        raise _refused(url, got="no URL") from None
    if kind not in ("sqlite", "postgresql") or not database or database == ":memory:":
        raise _refused(url, got=redacted_url(url))
    if kind == "postgresql":
        return parts._replace(scheme="postgresql+psycopg").geturl()
    file = Path(database).resolve()
    if (system := _filesystem(file)) in _NETWORK:
        raise InputError(
            "SQLite cannot be used on a network disk",
            where=file,
            expected="a local disk: its locks do not hold across machines",
            got=system,
            fix="put the queue on a local disk with --db, or use PostgreSQL",
        )
    return f"sqlite:///{file}"


def redacted_url(url: str) -> str:
    """The URL without its password."""
    try:
        parts = urlsplit(url)
    except ValueError:
        return "(no URL)"
    if not parts.scheme:
        return "(no URL)"
    name, at, host = parts.netloc.rpartition("@")
    user, colon, _ = name.partition(":")
    return parts._replace(netloc=f"{user}{colon and ':***'}{at}{host}").geturl()


def sqlite_file(url: str) -> Path:
    """The file of a URL that `checked_url` returned."""
    return Path(url.removeprefix("sqlite:///"))


def prepare(url: str) -> None:
    """Set what has to be set once: SQLite's folder and its write-ahead log, four times as fast as the default journal.

    Raises:
        InputError: the database cannot be reached or made.
    """
    import sqlalchemy as sa

    try:
        if is_sqlite(url):
            file = sqlite_file(url)
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
    if is_sqlite(url) and not sqlite_file(url).is_file():
        got = "no such file"  # connecting would make it
    else:
        try:
            with reading(url) as ask:
                ask(f"SELECT 1 FROM {table(url, 'workflow_status')} LIMIT 1", {})
        except driver_errors(url) as error:
            got, *_ = str(error).splitlines() or ["nothing"]
    if got:
        raise InputError(
            "There is no queue",
            where=redacted_url(url),
            expected="a database that `gnmreg migrate` prepared",
            got=got,
            fix="check the URL, or run `gnmreg migrate`",
        )


def engine(url: str) -> "sa.Engine":
    """Our own connections that write, one at a time."""
    import sqlalchemy as sa

    if not is_sqlite(url):
        return sa.create_engine(url, poolclass=sa.pool.NullPool, connect_args={"connect_timeout": _CONNECT_S})
    made = sa.create_engine(url, poolclass=sa.pool.NullPool, connect_args={"timeout": _BUSY_S})

    @sa.event.listens_for(made, "connect")
    def _set(connection: Any, _record: object) -> None:
        connection.isolation_level = "IMMEDIATE"  # a reader that becomes a writer may find the file busy for good
        connection.execute("PRAGMA foreign_keys=ON")

    return made


@contextmanager
def reading(url: str) -> Iterator[Ask]:
    """A connection that the database itself keeps from writing. Raises `driver_errors`."""
    if is_sqlite(url):
        with closing(sqlite3.connect(sqlite_file(url), timeout=_BUSY_S)) as file:
            file.execute("PRAGMA query_only=ON")
            yield lambda query, values: file.execute(*_bound(query, values)).fetchall()
    else:
        import psycopg

        plain = url.replace("+psycopg", "", 1)
        with closing(psycopg.connect(plain, connect_timeout=_CONNECT_S, options=_READ_ONLY)) as server:
            yield lambda query, values: server.execute(*_for_psycopg(*_bound(query, values))).fetchall()


def driver_errors(url: str) -> type[Exception]:
    """What `reading` and its questions raise: the database cannot be reached, or does not answer."""
    if is_sqlite(url):
        return sqlite3.Error
    import psycopg

    return psycopg.Error


def _bound(query: str, values: Mapping[str, Any]) -> tuple[str, dict[str, Any]]:
    """A name for each element of a list."""
    bound: dict[str, Any] = {}
    for name, value in values.items():
        if not isinstance(value, Sequence) or isinstance(value, str):
            bound[name] = value
            continue
        bound |= {f"{name}_{number}": one for number, one in enumerate(value)}
        names = ", ".join(f":{name}_{number}" for number in range(len(value)))
        query = query.replace(f":{name}", f"({names})")
    return query, bound


def _for_psycopg(query: str, values: dict[str, Any]) -> tuple[Any, dict[str, Any]]:
    return re.sub(r"(?<!:):(\w+)", r"%(\1)s", query.replace("%", "%%")), values


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
