"""The queue's database: a SQLite file in WAL mode on one machine, or PostgreSQL for many. Only the URL differs.

Queries go directly to the drivers, because importing SQLAlchemy would double the time of `gnmreg status`; only code
that writes imports it.
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
ENVIRONMENT = "GNMREG_DB"  # for URLs with a password: every user can read command lines
_NETWORK = ("nfs", "nfs4", "cifs", "smb3", "smbfs", "9p", "lustre", "ceph", "glusterfs", "fuse.sshfs", "beegfs", "gpfs")
_BUSY_S, _CONNECT_S = 30.0, 30
_READ_ONLY = "-c default_transaction_read_only=on"
Ask = Callable[[str, Mapping[str, Any]], list[Any]]  # SQL with :names, their values (lists after IN) -> rows


def default_url(folder: Path) -> str:
    """Return the URL of the SQLite database of a farm's folder."""
    return f"sqlite:///{Path(folder).resolve() / FILE}"


def is_sqlite(url: str) -> bool:
    return url.startswith("sqlite")


def checked_url(url: str) -> str:
    """Return the URL in the form that this package uses.

    Raises:
        InputError: neither sqlite:///FILE nor postgresql://..., a SQLite file on a network disk, or no database name.
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
    """Return the URL without its password."""
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
    """Return the file of a URL that `checked_url` returned."""
    return Path(url.removeprefix("sqlite:///"))


def prepare(url: str) -> None:
    """Create SQLite's folder and set its write-ahead log, four times as fast as the default journal; or connect once.

    Raises:
        InputError: the database cannot be reached or created.
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
            expected="a writable SQLite file, or a PostgreSQL server that answers",
            got=first,
            fix="check the URL, the server and its password",
        ) from None


def require_queue(url: str) -> None:
    """Raise InputError if there is no queue at the URL, or it cannot be reached."""
    got = ""
    if is_sqlite(url) and not sqlite_file(url).is_file():
        got = "no such file"  # connecting would create it
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
    """Return an engine for writing, without a pool of connections."""
    import sqlalchemy as sa

    if not is_sqlite(url):
        return sa.create_engine(url, poolclass=sa.pool.NullPool, connect_args={"connect_timeout": _CONNECT_S})
    created = sa.create_engine(url, poolclass=sa.pool.NullPool, connect_args={"timeout": _BUSY_S})

    @sa.event.listens_for(created, "connect")
    def _set(connection: Any, _record: object) -> None:
        connection.isolation_level = "IMMEDIATE"  # a reader that becomes a writer may find the file busy forever
        connection.execute("PRAGMA foreign_keys=ON")

    return created


@contextmanager
def reading(url: str) -> Iterator[Ask]:
    """Open a connection that cannot write, and yield its query function. Raises `driver_errors`."""
    if is_sqlite(url):
        with closing(sqlite3.connect(sqlite_file(url), timeout=_BUSY_S)) as file:
            file.execute("PRAGMA query_only=ON")
            yield lambda query, values: file.execute(*_bind(query, values, ":{}")).fetchall()
    else:
        import psycopg

        plain = url.replace("+psycopg", "", 1)
        with closing(psycopg.connect(plain, connect_timeout=_CONNECT_S, options=_READ_ONLY)) as server:
            yield lambda query, values: server.execute(*_bind(query.replace("%", "%%"), values, "%({})s")).fetchall()


def driver_errors(url: str) -> type[Exception]:
    """Return the error of `reading` and its queries: the database cannot be reached, or does not answer."""
    if is_sqlite(url):
        return sqlite3.Error
    import psycopg

    return psycopg.Error


def _bind(query: str, values: Mapping[str, Any], placeholder: str) -> tuple[Any, dict[str, Any]]:
    """The query with a driver's placeholders for `:name`, and the values; a list becomes one placeholder an element.

    What SQLAlchemy's `bindparam(expanding=True)` does, without importing it.
    """
    bound: dict[str, Any] = {}

    def placeholders(match: re.Match[str]) -> str:
        name = match[1]
        value = values[name]
        if not isinstance(value, Sequence) or isinstance(value, str):
            bound[name] = value
            return placeholder.format(name)
        elements = {f"{name}_{number}": element for number, element in enumerate(value)}
        bound.update(elements)
        return f"({', '.join(map(placeholder.format, elements))})"

    return re.sub(r"(?<!:):(\w+)", placeholders, query), bound


def table(url: str, name: str) -> str:
    """Return the name of one of DBOS's tables in SQL."""
    return name if is_sqlite(url) else f"{SCHEMA}.{name}"


def below(run: str) -> dict[str, str]:
    """Return the parameters of `BELOW` for all jobs of a run, or of a part of it."""
    escaped = run.replace("\\", "\\\\").replace("%", "\\%").replace("_", "\\_")
    return {"run": run, "below": f"{escaped}/%"}


BELOW = "(workflow_uuid = :run OR workflow_uuid LIKE :below ESCAPE '\\')"


def _filesystem(file: Path) -> str:
    """The type of the filesystem of a path, as /proc/mounts names it; empty where there is no such file."""
    longest, filesystem = "", ""
    try:
        lines = Path("/proc/mounts").read_text().splitlines()
    except OSError:
        return ""
    for line in lines:
        _, point, kind, *_ = line.split(" ")
        point = point.replace("\\040", " ")
        inside = str(file) == point or str(file).startswith(point.rstrip("/") + "/")
        if inside and len(point) >= len(longest):
            longest, filesystem = point, kind
    return filesystem


def _refused(url: str, *, got: str) -> InputError:
    return InputError(
        "The queue's URL cannot be used",
        where=f"--db or {ENVIRONMENT}",
        expected="sqlite:////path/of/queue.sqlite or postgresql://user:password@host/database",
        got=got,
        fix="correct the URL",
    )
