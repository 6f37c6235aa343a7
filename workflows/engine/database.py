"""The queue's database: a SQLite file in WAL mode on one machine, or PostgreSQL for many. Only the URL differs.

Queries go directly to the drivers, because importing SQLAlchemy would double the time of `gnmreg status`; only code
that writes imports it.
"""

import os
import re
import sqlite3
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import parse_qsl, quote, unquote

from registration.errors import InputError
from workflows.ids import SECRET_NAME, redact

if TYPE_CHECKING:
    import sqlalchemy as sa

FILE = "queue.sqlite"
SCHEMA = "dbos"  # on PostgreSQL
ENVIRONMENT = "GNMREG_DB"  # for URLs with a password: every user can read command lines
_DRIVER, _PASSWORD = "postgresql+psycopg", "PGPASSWORD"
SECRETS = (ENVIRONMENT, _PASSWORD)  # environment variables that may hold a password
_POSTGRES = re.compile(
    r"postgresql(?:\+\w+)?://(?:(?P<user>[^:@/?#]*)(?::(?P<password>.*))?@)?"
    r"(?P<host>[^@/?#]*)/(?P<database>[^@/?#]+)(?:\?(?P<query>.*))?",
    re.DOTALL,
)
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
    if not is_sqlite(url):
        return _postgres_url(url)
    database = re.sub(r"^sqlite(\+\w+)?:///", "", url)
    if database in (url, "", ":memory:") or "?" in database:
        raise _refused(url, got=redacted_url(url))
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


def with_environments_password(url: str) -> str:
    """Return a URL with the password of the environment variable PGPASSWORD if it has none, as libpq would use it."""
    password, parts = os.environ.get(_PASSWORD), _POSTGRES.fullmatch(url)
    if not password or parts is None or parts["password"]:
        return url
    return f"{_DRIVER}://{parts['user'] or ''}:{quote(password, safe='')}@{url.partition('://')[2].rpartition('@')[2]}"


def redacted_url(url: str) -> str:
    """Return the URL without its passwords, for messages; of a URL that cannot be read only its scheme."""
    if is_sqlite(url):
        return redact(url)
    parts = _POSTGRES.fullmatch(url)
    if parts is None:
        scheme, separator, _ = url.partition("://")
        return f"{scheme}://..." if separator and scheme.replace("+", "").isalnum() else "(no URL)"
    from sqlalchemy.engine import URL  # loaded for messages only: it would double the time of `gnmreg status`

    shown = {key: "***" if SECRET_NAME.search(key) else value for key, value in parse_qsl(parts["query"] or "")}
    host, _, port = parts["host"].rpartition(":") if parts["host"][-1:].isdigit() else (parts["host"], "", "")
    host, number = (host, int(port)) if host and port.isdigit() else (parts["host"], None)
    name = URL.create("postgresql", parts["user"], parts["password"], host, number, parts["database"], shown)
    return name.render_as_string(hide_password=True).replace("%2A%2A%2A", "***")


def without_secrets(text: str, url: str) -> str:
    """Return a message about a database, such as a driver's, without the passwords of its URL."""
    parts = _POSTGRES.fullmatch(url)
    if parts is not None:
        pairs = parse_qsl(parts["query"] or "")
        secrets = [parts["password"], *(value for key, value in pairs if SECRET_NAME.search(key))]
        for secret in filter(None, secrets):
            for form in (secret, unquote(secret)):
                text = text.replace(form, "***") if len(form) > 3 else text
    return redact(text)


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
            got=without_secrets(first, url),
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
            got=without_secrets(got, url),
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
            file.text_factory = _text  # SQLite keeps bytes in any column
            yield lambda query, values: [
                tuple(_text(value) if isinstance(value, bytes) else value for value in row)
                for row in file.execute(*_bind(query, values, ":{}"))
            ]
    else:
        import psycopg

        plain = url.replace("+psycopg", "", 1)
        with closing(psycopg.connect(plain, connect_timeout=_CONNECT_S, options=_READ_ONLY)) as server:
            yield lambda query, values: server.execute(*_bind(query.replace("%", "%%"), values, "%({})s")).fetchall()


def _text(value: bytes) -> str:
    return value.decode("utf-8", "replace")


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


def _postgres_url(url: str) -> str:
    """The URL with the driver's name and an escaped password, which may hold any character.

    The password ends at the last "@" that a host and a database follow.
    """
    parts = _POSTGRES.fullmatch(url)
    if parts is None:
        raise _refused(url, got=redacted_url(url))
    pairs = parse_qsl(parts["query"] or "", keep_blank_values=True)
    password = unquote(parts["password"] or "") or dict(pairs).get("password")
    query = "&".join(item for item in (parts["query"] or "").split("&") if item.partition("=")[0] != "password")
    user = quote(unquote(parts["user"] or ""), safe="") + (f":{quote(password, safe='')}" if password else "")
    address = f"{user}{'@' if user else ''}{parts['host']}/{parts['database']}"
    return f"{_DRIVER}://{address}{'?' if query else ''}{query}"


def _refused(url: str, *, got: str) -> InputError:
    return InputError(
        "The queue's URL cannot be used",
        where=f"--db or {ENVIRONMENT}",
        expected="sqlite:////path/of/queue.sqlite or postgresql://user:password@host/database",
        got=got,
        fix="correct the URL",
    )
