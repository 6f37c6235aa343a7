"""The text of `gnmreg status`, and the ids that commands accept."""

import json
import re
import time
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

from registration.errors import InputError
from workflows.engine.database import is_sqlite, redacted_url, sqlite_file
from workflows.engine.jobs import GPU, REBUILD, VERSION
from workflows.engine.metrics import QueueMetrics, queue_metrics
from workflows.engine.reader import CANCELLED, DONE, FAILED, INTERRUPTED, RUNNING, WAITING, JobRow, QueueReader
from workflows.ids import check_id, nearest

CAPTURES_PER_DAY = 10_000  # the throughput that status compares with
MAX_KINDS = 20  # of failures that are listed
MAX_EXAMPLES = 3  # ids of each
ORDER = (RUNNING, INTERRUPTED, FAILED, WAITING, CANCELLED, DONE)  # of listed jobs
_TAIL_BYTES = 4096  # of a progress file
_MAX_NAMES = 5000  # among which near names are looked for


@dataclass(frozen=True, kw_only=True)
class JobFilter:
    """Which jobs are listed.

    Attributes:
        state: Only jobs in this state.
        subject: Only jobs of this subject: the name of the folder that holds its captures.
        text: Only jobs whose id, arguments or failure contain this text.
    """

    state: str | None = None
    subject: str | None = None
    text: str | None = None

    def accepts(self, row: JobRow) -> bool:
        """Return whether a job is listed."""
        if self.state is not None and row.state != self.state:
            return False
        if self.subject is not None and self.subject != subject_of(row):
            return False
        return self.text is None or self.text.lower() in _searchable(row).lower()


def status_lines(reader: QueueReader, run: str | None, logs: Path) -> list[str]:
    """Return what `gnmreg status` prints.

    Args:
        reader: of the queue.
        run: a run or a part of one; None: all.
        logs: folder of the jobs' logs, where the stage of a running job is found.

    Raises:
        InputError: there is no such run.
    """
    if run is not None:
        require_part(reader, run)
    figures = queue_metrics(reader, run)
    lines = [f"queue: {sqlite_file(reader.url) if is_sqlite(reader.url) else redacted_url(reader.url)}"]
    lines.append(f"jobs: {sum(figures.counts.values())} ({_by_state(figures.counts)})")
    lines.append(f"flows: {sum(figures.flows.values())} ({_by_state(figures.flows)})")
    percent = 100 * figures.a_day / CAPTURES_PER_DAY
    unit = "captures" if figures.captures else "jobs"
    rate = f"throughput: {figures.a_day:,.0f} {unit} in a day of work, {percent:.0f} % of {CAPTURES_PER_DAY:,}"
    lines.append(f"{rate}; {figures.ended_last_hour} ended in the last hour")
    if figures.left_s is not None:
        end = datetime.fromtimestamp(time.time() + figures.left_s).strftime("%Y-%m-%d %H:%M")
        lines.append(f"expected end: {end}, in {duration(figures.left_s)}, of the {figures.left} {unit} in the queue")
    lines += _process_lines(figures, logs)
    lines += remarks(figures)
    if figures.failures:
        lines.append("failed:")
        lines += [line for kind in figures.failures[:MAX_KINDS] for line in _failure_lines(kind)]
        if len(figures.failures) > MAX_KINDS:
            lines.append(f"        and {len(figures.failures) - MAX_KINDS} more kinds")
    return lines


def job_lines(reader: QueueReader, run: str | None, chosen: JobFilter, logs: Path, limit: int) -> list[str]:
    """Return a table of jobs: id, state, since when, stage or result, capture.

    Args:
        reader: of the queue.
        run: a run or a part of one; None: all.
        chosen: which jobs.
        logs: folder of the jobs' logs.
        limit: number of lines; 0: all.

    Raises:
        InputError: there is no such run or subject.
    """
    if run is not None:
        require_part(reader, run)
    jobs = [row for row in reader.listing(run) if row.kind == "job"]
    if chosen.subject is not None and not any(chosen.subject == subject_of(row) for row in jobs):
        raise _unknown("subject", chosen.subject, {subject_of(row) or "" for row in jobs} - {""})
    rows = sorted(filter(chosen.accepts, jobs), key=lambda row: (ORDER.index(row.state), -row.since, row.id))
    shown = rows[:limit] if limit else rows
    table = [("id", "state", "since", "stage", "capture"), *(_job_row(row, logs) for row in shown)]
    widths = [max(len(row[column]) for row in table) for column in range(4)]
    lines = ["  ".join((*(cell.ljust(w) for cell, w in zip(row, widths, strict=False)), row[4])) for row in table]
    more = f"; --limit {len(rows)} shows all" if len(shown) < len(rows) else ""
    return [*lines, f"{len(shown)} of {len(rows)} jobs{more}"]


def subject_of(row: JobRow) -> str | None:
    """Return the name of the folder that holds the subject's captures; None for a job of several subjects."""
    arguments = row.spec.get("arguments", {})
    if isinstance(arguments, dict):
        if isinstance(capture := arguments.get("capture"), str):
            return capture.rstrip("/").split("/")[-2] if "/" in capture.rstrip("/") else None
        if isinstance(folder := arguments.get("subject_dir"), str):
            return folder.rstrip("/").rpartition("/")[2]
    return None


def require_part(reader: QueueReader, part: str) -> None:
    """Raise InputError, with the nearest names, if nothing in the queue has this id or lies below it."""
    if not reader.ids(part):
        raise _unknown("run or job", part, _parts(reader.ids(), part))


def find_jobs(reader: QueueReader, typed: str) -> tuple[str, list[JobRow]]:
    """Return the id that an operator means, and the rows of that id, first, and below it.

    Args:
        reader: of the queue.
        typed: an id as status prints it; the end of one, such as ann/smile, also without the numbers in it; the name of
            a round's step, such as RUN/it00/build; or a run, a round or a subject, for all that is below.

    Raises:
        InputError: nothing is named so, or several things are.
    """
    ids = reader.ids()
    identity = typed
    if not any(known == typed or known.startswith(f"{typed}/") for known in ids):
        ends = [known for known in ids if f"/{_plain(known)}".endswith(f"/{_plain(typed)}")]
        if not ends:
            raise _unknown("job", typed, _parts(ids, typed))
        if len({_plain(known) for known in ends}) > 1:
            raise InputError(
                "Several jobs are named so",
                where="JOB",
                expected="the id of one job",
                got=typed,
                fix=f"name one of {', '.join(sorted(ends)[:10])}",
            )
        identity = max(reader.rows(ends).values(), key=lambda row: row.created).id
    rows = reader.listing(identity)
    return identity, sorted(rows, key=lambda row: (row.id != identity, ORDER.index(row.state), -row.created))


def group_lines(identity: str, rows: Sequence[JobRow], limit: int = 20) -> list[str]:
    """Return a summary of a run, a round or a subject: its state, then the jobs below it."""
    own = [row for row in rows if row.id == identity]
    jobs = [row for row in rows if row.kind == "job"]
    counts: dict[str, int] = {}
    for row in jobs:
        counts[row.state] = counts.get(row.state, 0) + 1
    lines = [f"{identity}: {own[0].state if own else 'a group'}; jobs: {len(jobs)} ({_by_state(counts)})"]
    lines += [f"{row.failure['status']}: {row.failure['reason']}" for row in own if row.failure]
    lines += [f"  {row.state:11s}  {row.id}{_short_reason(row)}" for row in jobs[:limit]]
    return [*lines, *([f"  and {len(jobs) - limit} more"] if len(jobs) > limit else [])]


def _process_lines(figures: QueueMetrics, logs: Path) -> Iterator[str]:
    by_executor = {row.executor: row for row in figures.running}
    for name in figures.processes:
        row = by_executor.get(name)
        if row is not None:
            yield f"{name}: {row.id}, {stage_of(row, logs)}, for {duration(time.time() - row.since)}"
        else:
            yield f"{name}: {'runs' if is_coordinator(name) else 'idle'}"


def is_coordinator(name: str) -> bool:
    """Return whether a process of this name is a coordinator."""
    return re.search(r"-coordinator\d+$", name) is not None


def remarks(figures: QueueMetrics) -> Iterator[str]:
    """Yield what keeps jobs waiting."""
    workers = [name for name in figures.processes if not is_coordinator(name)]
    if figures.left and not workers:
        yield "no worker runs: jobs wait until one starts (gnmreg worker, or the command with --local again)"
    elif figures.left and not any(map(is_coordinator, figures.processes)) and _active(figures.flows):
        yield "no coordinator runs: flows wait until one starts (gnmreg coordinator)"
    for name in figures.unserved if workers else ():
        if name in (GPU, REBUILD):
            yield f"no worker takes jobs of the queue {name}: start one with --queue {name}"
    if figures.uncovered:
        some = ", ".join(figures.uncovered[:MAX_EXAMPLES])
        text = f"{len(figures.uncovered)} jobs lie outside the roots of all workers, e.g. {some}"
        yield f"{text}: start a worker with --root and the folders of their captures, model and results"
    for version in figures.foreign:
        yield f"jobs of the version {version} wait: processes of this release take those of {VERSION} only"


def _active(counts: dict[str, int]) -> int:
    return sum(counts.get(state, 0) for state in (WAITING, RUNNING, INTERRUPTED))


def _failure_lines(kind: Any) -> Iterator[str]:
    yield f"{len(kind.jobs):7d}  {kind.kind}"
    yield f"         {kind.reason}"
    if kind.fix and kind.fix not in kind.reason:
        yield f"         fix: {kind.fix}"
    more = f" and {len(kind.jobs) - MAX_EXAMPLES} more" if len(kind.jobs) > MAX_EXAMPLES else ""
    yield f"         {', '.join(kind.jobs[:MAX_EXAMPLES])}{more}"


def _job_row(row: JobRow, logs: Path) -> tuple[str, str, str, str, str]:
    arguments = row.spec.get("arguments")
    arguments = arguments if isinstance(arguments, dict) else {}
    place = arguments.get("capture") or arguments.get("subject_dir") or arguments.get("out") or ""
    since = datetime.fromtimestamp(row.since).strftime("%Y-%m-%d %H:%M:%S")
    stage = stage_of(row, logs)
    if row.state == FAILED and row.failure:
        stage = f"{row.failure.get('status')}"
    elif row.state == DONE and row.started and row.ended:
        stage = f"{row.spec.get('step')}, {duration(row.ended - row.started)}"
    elif row.state in (WAITING, CANCELLED):
        stage = str(row.spec.get("step"))
    return row.id, row.state, since, stage, str(place)


def stage_of(row: JobRow, logs: Path) -> str:
    """Return what a running job does, from the last line of its progress beside its log, if that is on this machine."""
    step = str(row.spec.get("step"))
    try:
        with (logs / f"{check_id(row.id)}.jsonl").open("rb") as file:
            file.seek(0, 2)
            file.seek(max(0, file.tell() - _TAIL_BYTES))
            lines = file.read().decode("utf-8", "replace").splitlines()
    except (OSError, InputError):
        return step
    for line in reversed(lines):
        try:
            value = json.loads(line)
        except ValueError:
            continue
        if isinstance(value, dict) and value.get("what") and value.get("time", 0) >= (row.started or 0):
            return f"{value['what']} {value.get('done')} of {value.get('total')}"
    return step


def _searchable(row: JobRow) -> str:
    return "\n".join((row.id, json.dumps(row.spec, ensure_ascii=False), json.dumps(row.failure, ensure_ascii=False)))


def _short_reason(row: JobRow) -> str:
    return f": {row.failure['status']}: {row.failure['reason']}" if row.failure else ""


def _by_state(counts: dict[str, int]) -> str:
    return ", ".join(f"{counts[state]} {state}" for state in sorted(counts)) or "none"


def duration(seconds: float) -> str:
    """Return a duration in words."""
    if seconds < 90:
        return f"{seconds:.0f} s"
    minutes = round(seconds / 60)
    if minutes < 90:
        return f"{minutes} min"
    hours, minutes = divmod(minutes, 60)
    return f"{hours} h {minutes} min" if hours < 48 else f"{hours // 24} days {hours % 24} h"


def _plain(identity: str) -> str:
    """An id without the numbers of subjects and expressions and the digests of steps, which nobody types."""
    parts = [re.sub(r"^(?:s\d{5}|e\d{3}|neutral)-(?=.)", "", part) for part in identity.split("/")]
    return "/".join((*parts[:-1], re.sub(r"-[0-9a-f]{8}$", "", parts[-1])))


def _parts(ids: Iterable[str], typed: str) -> set[str]:
    """What could have been meant: ids and their beginnings; of very many, runs and what is beside the typed id."""
    split = [identity.split("/") for identity in ids]
    parts = {"/".join(words[:count]) for words in split for count in range(1, len(words) + 1)}
    if len(parts) <= _MAX_NAMES:
        return parts
    beside = f"{typed.rpartition('/')[0]}/"
    near = {part for part in parts if "/" not in part or part.startswith(beside)}
    return near if len(near) <= _MAX_NAMES else {part for part in parts if "/" not in part}


def _unknown(kind: str, typed: str, known: Iterable[str]) -> InputError:
    names = sorted(known)
    close = nearest(typed, names)
    listed = ", ".join(close or names[:10]) or f"nothing: the queue has no {kind}"
    return InputError(
        f"There is no such {kind}",
        where=kind,
        expected=f"one of {listed}" if names else listed,
        got=typed,
        fix=f"did you mean {close[0]}? see `gnmreg status --jobs`" if close else "see `gnmreg status --jobs`",
    )
