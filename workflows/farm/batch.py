"""A batch: many independent captures, registered as the jobs of one run."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path, PurePosixPath

from registration.errors import InputError
from registration.options import RegisterOptions
from registration.storage.reading import read_list
from registration.storage.records import to_json
from workflows.engine.jobs import DRIVER, FlowJob, Job
from workflows.ids import check_id, redact
from workflows.records.remote import is_remote, local_path
from workflows.steps import table
from workflows.steps.job_options import to_job


@dataclass(frozen=True, kw_only=True)
class Batch:
    """The jobs of a run."""

    run: str
    jobs: tuple[Job, ...]
    roots: tuple[str, ...]  # folders and URLs that contain all paths of the jobs


def batch_jobs(
    captures: Sequence[str],
    *,
    model: str,
    out: str,
    run: str | None = None,
    options: RegisterOptions = RegisterOptions(),  # noqa: B008  frozen
) -> Batch:
    """Return one job for each capture.

    Args:
        captures: folders, URLs, or @FILE with one of them per line.
        model: file or URL.
        out: the store, a folder or URL.
        run: name of the run; None: that of the store.
        options: of all registrations.

    Raises:
        InputError: there is no capture, one cannot be found, the model is missing, two captures have one name, or the
            options cannot be used by a worker.
    """
    shared = {"model": _absolute(model), "store": _absolute(out), "options": to_json(to_job(options))}
    locations = [location for word in captures for location in _expand(word)]
    if not locations:
        raise _input_error("There is nothing to register", where="CAPTURE", expected="captures", got="none")
    if not is_remote(model) and not local_path(model).is_file():
        raise _input_error("The model is missing", where=model, expected="a GNM NPZ file", got="no such file")
    name = run or PurePosixPath(out.rstrip("/")).name
    by_key = _keys([_absolute(location) for location in locations])
    jobs = tuple(
        Job(
            id=check_id(f"{name}/{key}"),
            step=table.REGISTER_STORED,
            arguments={"capture": location, "key": key, **shared},
        )
        for key, location in by_key.items()
    )
    inputs = {location.rpartition("/")[0] for location in (*by_key.values(), _absolute(model))}
    return Batch(run=check_id(name), jobs=jobs, roots=(*sorted(inputs), _absolute(out)))


def submit_batch(url: str, batch: Batch) -> int:
    """Put the jobs and their driver into the queue at `url`; existing ones are kept. Returns the number of jobs."""
    from workflows.engine.client import QueueClient

    queue = QueueClient(url)
    try:
        count = queue.submit(batch.jobs)
        driver = FlowJob(id=batch.run, flow="batch", queue=DRIVER)
        queue.submit([driver])
        queue.requeue([batch.run])  # a driver that had ended waits for the new jobs
    finally:
        queue.close()
    return count


def _expand(word: str) -> list[str]:
    if not word.startswith("@"):
        return [word]
    file = Path(word[1:])
    fix = "write one path or URL on each line"
    return read_list(file, partial(InputError, "The list of captures cannot be read", where=file, fix=fix))


def _keys(locations: Sequence[str]) -> Mapping[str, str]:
    """Key -> location. The key is the last two folders: it does not depend on the other captures of the batch."""
    for location in locations:
        if not is_remote(location) and not (local_path(location) / "capture.toml").is_file():
            expected = "a folder with capture.toml"
            raise _input_error("A capture cannot be found", where=location, expected=expected, got="none")
    by_key: dict[str, str] = {}
    for location in locations:
        key = "/".join(PurePosixPath(location).parts[-2:])
        if key in by_key:
            expected = "captures that differ in the names of their last two folders"
            raise _input_error("Two captures have the same key", where=location, expected=expected, got=by_key[key])
        by_key[key] = location
    return by_key


def _absolute(location: str) -> str:
    return location.rstrip("/") if is_remote(location) else str(local_path(location).resolve())


def _input_error(what: str, *, where: object, expected: str, got: object) -> InputError:
    return InputError(what, where=redact(str(where)), expected=expected, got=got, fix="correct the command")
