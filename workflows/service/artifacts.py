"""Results by their content id: which files they have, and where these are; nothing outside the service's places."""

import os
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from http import HTTPStatus
from pathlib import Path
from typing import IO, Any

from registration.errors import InputError
from registration.storage.reading import open_file, read_json
from workflows.engine.reader import JobRow
from workflows.records.store import Store
from workflows.service.archives import files_of
from workflows.service.problems import Problem
from workflows.service.state import ServiceState

_CONTENT_ID = re.compile("[0-9a-f]{64}")
_MANIFEST = "manifest.json"  # of a registration's folder


@dataclass(frozen=True)
class ResultFile:
    """A file of a result."""

    size: int  # bytes
    open: Callable[[], IO[bytes]]


@dataclass(frozen=True, kw_only=True)
class Result:
    """The files of a result, by name."""

    job: str
    files: Mapping[str, ResultFile]
    about: Mapping[str, Any]
    is_final: bool  # whether the files never change: those of a store are published once


def find_result(state: ServiceState, content_id: str) -> Result:
    """Return the result of a content id.

    Raises:
        Problem: 404 if no job has it, or it was superseded or deleted since; 403 if it lies outside the service's
            places.
    """
    if _CONTENT_ID.fullmatch(content_id):
        rows = state.reader.rows(state.board.jobs_with(content_id)[:20])
        for row in rows.values():
            try:
                found = _of_job(state, row, content_id)
            except InputError:  # damaged or unreadable: another job may have it, too
                continue
            if found is not None:
                return found
    raise Problem.missing("artifact", content_id, "see content_id of the jobs at /api/v1/jobs")


def _of_job(state: ServiceState, row: JobRow, content_id: str) -> Result | None:
    result, arguments = (row.result or {}).get("result"), row.spec.get("arguments")
    if not isinstance(result, dict) or not isinstance(arguments, dict):
        return None
    key, store, out = result.get("key"), arguments.get("store"), result.get("out")
    if isinstance(store, str) and isinstance(key, str):
        return _in_store(Store(state.places.check(store, "store")), key, row.id, content_id)
    if isinstance(out, str):
        return _in_folder(Path(state.places.check(out, "out")), row.id, content_id)
    return None


def _in_store(store: Store, key: str, job: str, content_id: str) -> Result | None:
    artifact = store.find(key)
    if artifact is None or artifact.content_id != content_id:
        return None
    files = {
        name: ResultFile(stored.bytes, partial(store.open, artifact, name)) for name, stored in artifact.files.items()
    }
    return Result(job=job, files=files, about=artifact.about, is_final=True)


def _in_folder(folder: Path, job: str, content_id: str) -> Result | None:
    manifest = read_json(folder / _MANIFEST, partial(InputError.unreadable, "manifest", where=job, fix="see the log"))
    if not isinstance(manifest, dict) or manifest.get("content_id") != content_id:
        return None
    files = {
        name: ResultFile(path.stat().st_size, partial(_open, folder, path)) for name, path in files_of(folder).items()
    }
    about = {name: manifest.get(name) for name in ("status", "reason")}
    return Result(job=job, files=files, about=about, is_final=False)


def _open(folder: Path, path: Path) -> IO[bytes]:
    """Open a file of a folder. Raises Problem if a link leads it elsewhere."""
    if Path(os.path.realpath(path)) != path:
        raise Problem(HTTPStatus.FORBIDDEN, "The file is a link", where=path.relative_to(folder).as_posix())
    return open_file(path, partial(InputError.unreadable, "file", where=path.name, fix="see the log"))
