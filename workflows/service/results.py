"""Where the results of a job are, from its row: others can write to the queue, so every place is checked."""

from collections.abc import Mapping
from dataclasses import dataclass
from http import HTTPStatus
from pathlib import Path
from typing import TYPE_CHECKING, Any

from registration.errors import InputError
from workflows.engine.reader import JobRow
from workflows.ids import check_id, is_remote
from workflows.records.store import ATTEMPT, Store
from workflows.service.problems import Problem

if TYPE_CHECKING:
    from workflows.service.state import ServiceState

REGISTRATION = "registration"  # the folder within an attempt
REPORT, THUMBNAIL = "report.html", "thumbnail.jpg"


@dataclass(frozen=True, kw_only=True)
class JobResults:
    """The files of a job that registers a capture."""

    registration: Path  # its folder
    thumbnail: Path | None  # None: such a job makes none

    @property
    def report(self) -> Path:
        """The report's file, which need not exist."""
        return self.registration / REPORT


def arguments_of(row: JobRow) -> Mapping[str, Any]:
    """Return a job's arguments; empty for a row that this package did not write."""
    arguments = row.spec.get("arguments")
    return arguments if isinstance(arguments, Mapping) else {}


def results_of(state: "ServiceState", row: JobRow) -> JobResults | None:
    """Return where a job's files are; None if it has published none, or they are not on this machine.

    Raises:
        Problem: they lie outside the folders of the service, or the row names no place.
    """
    arguments = arguments_of(row)
    try:
        if "store" in arguments:
            return _stored(state, row, arguments)
        if "capture" in arguments and "out" in arguments:
            place = state.places.of_row(arguments["out"], "out")
            return None if is_remote(place) else JobResults(registration=Path(place), thumbnail=None)
    except InputError as error:
        raise Problem.of_input(error, HTTPStatus.NOT_FOUND) from None
    return None


def _stored(state: "ServiceState", row: JobRow, arguments: Mapping[str, Any]) -> JobResults | None:
    store = Store(state.places.of_row(arguments["store"], "store"))
    key = check_id(arguments.get("key", ""))
    if store.local is None:
        return None
    result = (row.result or {}).get("result")
    attempt = result.get("attempt") if isinstance(result, Mapping) else None
    if not isinstance(attempt, str):  # a failed registration is published, too
        artifact = store.find(key)
        attempt = artifact.attempt if artifact is not None else ""
    if not attempt.startswith(ATTEMPT) or "/" in attempt:
        return None
    folder = store.local / key / attempt
    return JobResults(registration=folder / REGISTRATION, thumbnail=folder / THUMBNAIL)
