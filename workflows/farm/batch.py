"""A batch: many independent captures, registered as the jobs of one run."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING

from registration.errors import InputError
from registration.options import RegisterOptions
from registration.storage.reading import read_list
from registration.storage.records import to_json
from workflows.engine.jobs import DRIVER, FlowJob, Job
from workflows.ids import check_id, id_part, is_remote, redact, resolve_place
from workflows.steps import table
from workflows.steps.job_options import to_job

if TYPE_CHECKING:
    from workflows.engine.client import Submission


@dataclass(frozen=True, kw_only=True)
class Batch:
    """The jobs of a run."""

    run: str
    jobs: tuple[Job, ...]
    roots: tuple[str, ...]  # folders and URLs that contain all paths of the jobs
    missing: tuple[str, ...] = ()  # captures that are not on this machine; their jobs will be bad input
    left_out: Mapping[str, str] = field(default_factory=dict)  # capture -> why it has no job

    @property
    def remarks(self) -> list[str]:
        """One line for each entry that cannot be used."""
        absent = [f"bad input: {location}: no folder with capture.toml" for location in self.missing]
        return absent + [f"bad input, left out: {location}: {reason}" for location, reason in self.left_out.items()]


def batch_jobs(
    captures: Sequence[str],
    *,
    model: str,
    out: str,
    run: str | None = None,
    options: RegisterOptions = RegisterOptions(),  # noqa: B008  frozen
) -> Batch:
    """Return one job for each capture. Entries that cannot be used do not stop the others.

    Args:
        captures: folders, URLs, or @FILE with one of them per line.
        model: file or URL.
        out: the store, a folder or URL.
        run: name of the run; None: that of the store.
        options: of all registrations.

    Raises:
        InputError: there is no capture that can be used, a list or the model is missing, or the options cannot be used
            by a worker.
    """
    model, store = resolve_place(model, "--model"), resolve_place(out, "--out")
    shared = {"model": model, "store": store, "options": to_json(to_job(options))}
    locations, refused = _places([location for word in captures for location in expand(word)])
    if not locations:
        expected, got = "captures", next((f"{word}: {reason}" for word, reason in refused.items()), "none")
        raise _input_error("There is nothing to register", where="CAPTURE", expected=expected, got=got)
    if not is_remote(model) and not Path(model).is_file():
        raise _input_error("The model is missing", where=model, expected="a GNM NPZ file", got="no such file")
    name = run or PurePosixPath(out.rstrip("/")).name
    by_key, left_out = _keys(locations)
    missing = tuple(location for location in by_key.values() if not _may_exist(location))
    if len(missing) == len(by_key):
        expected = "a folder with capture.toml"
        raise _input_error("No capture can be found", where=missing[0], expected=expected, got="none")
    jobs = tuple(
        Job(
            id=check_id(f"{name}/{key}"),
            step=table.REGISTER_STORED,
            arguments={"capture": location, "key": key, **shared},
        )
        for key, location in by_key.items()
    )
    inputs = {location.rpartition("/")[0] for location in (*by_key.values(), model)}
    return Batch(
        run=check_id(name),
        jobs=jobs,
        roots=(*sorted(inputs), store),
        missing=missing,
        left_out=refused | left_out,
    )


def submit_batch(url: str, batch: Batch) -> "Submission":
    """Put the jobs and their driver into the queue at `url`.

    Jobs that have ended are put there again, with the settings of this batch: a job whose inputs did not change returns
    its published result.

    Raises:
        InputError: there is no queue, the run is no batch, or a job runs with other settings.
    """
    from workflows.engine.client import QueueClient
    from workflows.engine.reader import QueueReader

    queue = QueueClient(url)
    driver = FlowJob(id=batch.run, flow="batch", queue=DRIVER)
    try:
        row = QueueReader(url, known=True).rows([batch.run]).get(batch.run)
        if row is not None and row.spec != driver.spec():
            raise InputError(
                "The run is no batch",
                where=batch.run,
                expected="a new name, or that of a batch",
                got="a coregistration" if row.spec.get("flow") == "coregister" else "another run",
                fix="name the run with --run",
            )
        submission = queue.resubmit(batch.jobs)
        queue.resubmit([driver])  # one that had ended waits for the new jobs
    finally:
        queue.close()
    return submission


def made_and_kept(url: str, batch: Batch) -> tuple[int, int]:
    """Return how many captures of a batch were registered, and how many results of the same inputs were kept."""
    from workflows.engine.reader import DONE, QueueReader

    rows = QueueReader(url, known=True).rows([job.id for job in batch.jobs]).values()
    results = [(row.result or {}).get("result") for row in rows if row.state == DONE]
    made = sum(isinstance(result, dict) and result.get("made") is not False for result in results)
    return made, len(results) - made


def expand(word: str) -> list[str]:
    """Return the captures that a word stands for: itself, or the lines of @FILE. Raises InputError."""
    if not word.startswith("@"):
        return [word]
    file = Path(word[1:])
    fix = "write one path or URL on each line"
    return read_list(file, partial(InputError, "The list of captures cannot be read", where=file, fix=fix))


def _places(words: Sequence[str]) -> tuple[list[str], dict[str, str]]:
    """The places that the words name, each once; and word -> why it names none."""
    places: dict[str, None] = {}
    refused: dict[str, str] = {}
    for word in words:
        try:
            places[resolve_place(word, "CAPTURE")] = None
        except InputError as error:
            refused[redact(word)] = f"expected {error.expected}, got {error.got}"
    return list(places), refused


def _keys(locations: Sequence[str]) -> tuple[dict[str, str], dict[str, str]]:
    """Key -> location, and location -> why it has none.

    The key is the last two folders: it does not depend on the other captures of the batch.
    """
    by_key: dict[str, str] = {}
    left_out: dict[str, str] = {}
    for location in locations:
        key = "/".join(id_part(part) for part in PurePosixPath(location).parts[-2:])
        if key in by_key:
            left_out[redact(location)] = f"the names of its last two folders are those of {redact(by_key[key])}"
        else:
            by_key[key] = location
    return by_key, left_out


def _may_exist(location: str) -> bool:
    return is_remote(location) or Path(location, "capture.toml").is_file()


def _input_error(what: str, *, where: object, expected: str, got: object) -> InputError:
    return InputError(what, where=redact(str(where)), expected=expected, got=got, fix="correct the command")
