"""The page and the table of a batch, in its store: written from the queue's rows while the batch proceeds."""

import time
from collections.abc import Mapping
from datetime import UTC, datetime
from pathlib import PurePosixPath
from typing import Any

from registration.errors import InputError
from workflows.engine.reader import DONE, FAILED, RUNNING, JobRow, QueueReader
from workflows.ids import check_id, redact
from workflows.pages.batch import render_batch_page
from workflows.records.batch import INTERRUPTED, BatchRow, BatchTable, ranked
from workflows.records.store import ATTEMPT, Store
from workflows.steps.register import REPORT, THUMBNAIL

PERIOD_S = 15.0  # least time between two versions of a page
MAX_LOAD = 0.05  # largest part of the time that is spent on them
UNUSABLE = "unusable"  # what became of a job whose registration failed, which is published nevertheless


class BatchPage:
    """`index.html` and `captures.csv` of a batch; `RUN.html` and `RUN.csv` if the run is not named like the store."""

    def __init__(self, url: str, run: str, out: str) -> None:
        """Nothing is read or written yet.

        Args:
            url: of the queue.
            run: name of the run.
            out: the store that the run publishes to, a folder or URL.

        Raises:
            InputError: the store cannot be used, the run's name is invalid, or there is no queue.
        """
        self._reader, self._run, self._store = QueueReader(url), check_id(run), Store(out)
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

    def update(self, counts: Mapping[str, int]) -> None:
        """Write the page if it shows other numbers of jobs by state, unless it was written a moment ago."""
        start_s = time.monotonic()
        if counts != self._shown and start_s >= self._next_s:
            self.write()
            self._shown = dict(counts)
            self._next_s = start_s + max(PERIOD_S, (time.monotonic() - start_s) / MAX_LOAD)

    def write(self, *, live: bool = True) -> None:
        """Write the page and the table. A failure does not concern the batch: it is noted in `problem`.

        Args:
            live: whether processes may work on the batch; otherwise jobs in progress are shown as interrupted.
        """
        try:
            rows = [self._row(job, live) for job in self._reader.jobs(self._run)]
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


def _mapping(value: Any) -> Mapping[str, Any]:
    return value if isinstance(value, Mapping) else {}


def _text(value: Any) -> str:
    return value if isinstance(value, str) else ""
