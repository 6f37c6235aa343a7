"""Which processes of a farm run: each holds a lock, of a file or of PostgreSQL, that is free when it has ended.

Imports no SQLAlchemy, because `gnmreg status` asks, too.
"""

import fcntl
import os
import zlib
from collections.abc import Iterable
from pathlib import Path

from workflows.engine.database import is_sqlite, reading, sqlite_file

LOCK_CLASS = 0x676E6D  # "gnm": the first of the two numbers of our advisory locks
HELD = (
    "SELECT CAST(l.objid AS bigint) FROM pg_locks l JOIN pg_database d ON d.oid = l.database "
    "WHERE l.locktype = 'advisory' AND l.classid = :class AND l.granted AND d.datname = current_database()"
)


def ended_processes(url: str, names: Iterable[str]) -> set[str]:
    """Return those of the executor ids whose process has ended, or has lost its connection to PostgreSQL."""
    wanted = set(names)
    if not wanted:
        return set()
    if is_sqlite(url):
        return {name for name in wanted if is_free(locks_folder(url), name)}
    with reading(url) as ask:
        held = {int(row[0]) for row in ask(HELD, {"class": LOCK_CLASS})}
    return {name for name in wanted if lock_key(name) % 2**32 not in held}


def lock_names(url: str) -> set[str]:
    """Return all executor ids that ever had a lock file beside a SQLite queue; none for PostgreSQL."""
    folder = locks_folder(url) if is_sqlite(url) else None
    return {path.name for path in folder.iterdir()} if folder is not None and folder.is_dir() else set()


def locks_folder(url: str) -> Path:
    """Return the folder of the lock files of a SQLite queue, one for each executor id."""
    database = sqlite_file(url)
    return database.with_name(f"{database.name}.locks")


def is_free(folder: Path, name: str) -> bool:
    """Return whether no process holds the lock file of an executor id."""
    try:
        descriptor = os.open(folder / os.path.basename(name), os.O_RDONLY)
    except PermissionError:
        raise
    except (OSError, ValueError):  # there is none, or the name, which others may have written, is no file's
        return True
    try:
        fcntl.flock(descriptor, fcntl.LOCK_SH | fcntl.LOCK_NB)
        return True
    except OSError:
        return False
    finally:
        os.close(descriptor)


def lock_key(name: str) -> int:
    """Return the second number of an executor id's advisory lock, a signed 32 bit integer."""
    digest = zlib.crc32(name.encode())
    return digest - 2**32 if digest >= 2**31 else digest
