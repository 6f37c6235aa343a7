"""A batch: many captures, each registered by itself, as jobs of one run."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

from registration.errors import InputError
from registration.options import RegisterOptions
from registration.storage.records import to_json
from workflows.engine.jobs import DRIVER, FlowJob, Job
from workflows.ids import check_id, redact
from workflows.records.remote import is_remote, local_path
from workflows.steps import table
from workflows.steps.job_options import to_job


@dataclass(frozen=True, kw_only=True)
class Batch:
    """What goes into the queue."""

    run: str
    jobs: tuple[Job, ...]
    roots: tuple[str, ...]  # below which all its places lie


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
    places = [place for word in captures for place in _listed(word)]
    if not places:
        raise _wrong("There is nothing to register", where="CAPTURE", expected="captures", got="none")
    if not is_remote(model) and not local_path(model).is_file():
        raise _wrong("The model is missing", where=model, expected="a GNM NPZ file", got="no such file")
    name = run or PurePosixPath(out.rstrip("/")).name
    names = _names([_absolute(place) for place in places])
    jobs = tuple(
        Job(
            id=check_id(f"{name}/{key}"),
            step=table.REGISTER_STORED,
            arguments={"capture": place, "key": key, **shared},
        )
        for key, place in names.items()
    )
    inputs = {place.rpartition("/")[0] for place in (*names.values(), _absolute(model))}
    return Batch(run=check_id(name), jobs=jobs, roots=(*sorted(inputs), _absolute(out)))


def submit_batch(url: str, batch: Batch) -> int:
    """Put the jobs and their driver into the queue at `url`; what is there already stays. Returns how many jobs."""
    from workflows.engine.client import QueueClient

    queue = QueueClient(url)
    try:
        count = queue.submit(batch.jobs)
        driver = FlowJob(id=batch.run, flow="batch", queue=DRIVER)
        queue.submit([driver])
        queue.requeue([batch.run])  # it waits for what is new, if it had ended
    finally:
        queue.close()
    return count


def _listed(word: str) -> list[str]:
    if not word.startswith("@"):
        return [word]
    file = Path(word[1:])
    try:
        return [line.strip() for line in file.read_text("utf-8").splitlines() if line.strip()]
    except (OSError, UnicodeDecodeError) as error:
        expected = "a path or URL a line"
        raise _wrong("The list of captures cannot be read", where=file, expected=expected, got=error) from None


def _names(places: Sequence[str]) -> Mapping[str, str]:
    """Key -> place. A key is a place's last two folders, whatever else is in the batch: so it is always the same."""
    for place in places:
        if not is_remote(place) and not (local_path(place) / "capture.toml").is_file():
            raise _wrong("A capture cannot be found", where=place, expected="a folder with capture.toml", got="none")
    names: dict[str, str] = {}
    for place in places:
        key = "/".join(PurePosixPath(place).parts[-2:])
        if key in names:
            expected = "captures that differ in the names of their last two folders"
            raise _wrong("Two captures cannot be told apart", where=place, expected=expected, got=names[key])
        names[key] = place
    return names


def _absolute(place: str) -> str:
    return place.rstrip("/") if is_remote(place) else str(local_path(place).resolve())


def _wrong(what: str, *, where: object, expected: str, got: object) -> InputError:
    return InputError(what, where=redact(str(where)), expected=expected, got=got, fix="correct the command")
