"""The page and the table of a batch, in its store: written from the queue's rows while the batch proceeds."""

import time
from collections.abc import Mapping
from datetime import UTC, datetime
from pathlib import PurePosixPath
from types import MappingProxyType
from typing import Any

from registration.errors import InputError
from workflows.engine.reader import DONE, FAILED, RUNNING, JobRow, QueueReader
from workflows.ids import check_id, redact, resolve_place
from workflows.pages.batch import render_batch_page
from workflows.records.batch import INTERRUPTED, BatchRow, BatchTable, ranked
from workflows.records.store import ATTEMPT, Store
from workflows.steps.register import REPORT, THUMBNAIL

PERIOD_S = 15.0  # least time between two versions of a page
MAX_LOAD = 0.05  # largest part of the time that is spent on them
NONE: Mapping[str, str] = MappingProxyType({})
BAD_INPUT = "bad input"
UNUSABLE = "unusable"  # what became of a job whose registration failed, which is published nevertheless


class BatchPage:
    """`index.html` and `captures.csv` of a batch; `RUN.html` and `RUN.csv` if the run is not named like the store."""

    def __init__(self, url: str, run: str, out: str, left_out: Mapping[str, str] = NONE) -> None:
        """Nothing is read or written yet.

        Args:
            url: of the queue.
            run: name of the run.
            out: the store that the run publishes to, a folder or URL.
            left_out: captures that have no job -> the reason.

        Raises:
            InputError: the store cannot be used, the run's name is invalid, or there is no queue.
        """
        self._reader, self._run, self._store = QueueReader(url), check_id(run), Store(out)
        self._left_out = left_out
        stem = run.replace("/", "_")
        named_alike = run == PurePosixPath(out.rstrip("/")).name
        self.page, self.table = ("index.html", "captures.csv") if named_alike else (f"{stem}.html", f"{stem}.csv")
        self.problem = ""  # why the last version could not be written
        self._shown: Mapping[str, int] | None = None
        self._next_s = 0.0

    @property
    def location(self) -> str:
        """Path or URL of the page."""
        return redact(f"{self._store.url.rstrip('/')}/{self.page}")

    def update(self, counts: Mapping[str, int] | None = None) -> None:
        """Write the page if it shows other numbers of jobs by state, unless it was written a moment ago.

        Args:
            counts: the numbers, if they are known.
        """
        start_s = time.monotonic()
        if start_s < self._next_s:
            return
        counts = self._reader.counts(self._run, kind="job") if counts is None else counts
        if counts != self._shown:
            self.write()
            self._shown = dict(counts)
            self._next_s = start_s + max(PERIOD_S, (time.monotonic() - start_s) / MAX_LOAD)

    def write(self, *, live: bool = True) -> None:
        """Write the page and the table. A failure does not concern the batch: it is noted in `problem`.

        Args:
            live: whether processes may work on the batch; otherwise jobs in progress are shown as interrupted.
        """
        try:
            rows = [self._row(job, live) for job in self._reader.listing(self._run) if job.kind == "job"]
            rows += [_left_out(capture, reason) for capture, reason in self._left_out.items()]
            written = datetime.now(UTC).strftime("%Y-%m-%d %H:%M:%S")
            table = BatchTable(run=self._run, written=written, rows=ranked(rows), live=live)
            self._store.write_page(self.page, render_batch_page(table, csv_file=self.table))
            self._store.write_page(self.table, table.to_csv())
        except Exception as error:  # whatever a database or object storage raises
            self.problem = f"the page {self.location} cannot be written: {redact(str(error))}"
        else:
            self.problem = ""

    def _row(self, job: JobRow, live: bool) -> BatchRow:
        arguments = _mapping(job.spec.get("arguments"))
        about, folder = self._published(job)
        state, status, reason = job.state, job.state, ""
        if state == DONE:
            status, reason = _text(about.get("status")) or DONE, _text(about.get("reason"))
        elif state == FAILED and job.failure:
            status, reason = _text(job.failure["status"]), _text(job.failure["reason"])
        elif state == RUNNING and not live:
            state = status = INTERRUPTED
        seconds = about.get("seconds")
        return BatchRow(
            name=job.id.removeprefix(f"{self._run}/"),
            source=redact(_text(arguments.get("capture"))),
            job=job.id,
            state=state,
            status=status,
            reason=redact(reason),
            figures=_mapping(about.get("figures")),
            seconds=float(seconds) if isinstance(seconds, int | float) else None,
            report=folder and f"{folder}/{REPORT}",
            thumbnail=folder and about.get("thumbnail") and f"{folder}/{THUMBNAIL}",
        )

    def _published(self, job: JobRow) -> tuple[Mapping[str, Any], str | None]:
        """What is known about the registration that a job published, and the folder of its files in the store."""
        key = job.id.removeprefix(f"{self._run}/")
        if job.state == DONE:
            result = _mapping((job.result or {}).get("result"))
            attempt, about = _text(result.get("attempt")), _mapping(result.get("about"))
        elif job.state == FAILED and (job.failure or {}).get("status") == UNUSABLE:
            try:
                artifact = self._store.find(key)
            except InputError:
                artifact = None
            attempt, about = (artifact.attempt, artifact.about) if artifact else ("", {})
        else:
            return {}, None
        inside = attempt.startswith(ATTEMPT) and "/" not in attempt  # others can write to the queue
        return about, f"{key}/{attempt}" if inside else None


def batch_page(url: str, run: str | None, out: str) -> BatchPage:
    """Return the page of a batch that is in the queue.

    Args:
        url: of the queue.
        run: name of the run.
        out: the store; that in the queue is not trusted, since others may write there.

    Raises:
        InputError: as `BatchPage`; no run is named, or there is no batch of that name that publishes to this store.
    """
    fix = "name the batch with --run, and the store that its command named with --out"
    if run is None:
        raise _refused(expected="the name of a batch", got="no run", fix=fix)
    arguments = [_mapping(row.spec.get("arguments")) for row in QueueReader(url).listing(run) if row.kind == "job"]
    stores = {_text(item.get("store")) for item in arguments if "store" in item}
    if resolve_place(out, "--page") not in stores:
        shown = ", ".join(sorted(redact(store) for store in stores)) or "a batch"
        raise _refused(expected=f"the store of {run}: {shown}", got=redact(out), fix=fix)
    return BatchPage(url, run, out)


def _refused(*, expected: str, got: str, fix: str) -> InputError:
    return InputError("There is no batch to write a page of", where="--page", expected=expected, got=got, fix=fix)


def _left_out(capture: str, reason: str) -> BatchRow:
    """The row of a capture that has no job."""
    source = redact(capture)
    return BatchRow(name=source, source=source, job="", state=FAILED, status=BAD_INPUT, reason=redact(reason))


def _mapping(value: Any) -> Mapping[str, Any]:
    return value if isinstance(value, Mapping) else {}


def _text(value: Any) -> str:
    return value if isinstance(value, str) else ""
