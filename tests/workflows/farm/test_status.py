"""What status says of a real queue whose rows pretend what workers did, and which ids commands accept."""

import json
import sqlite3
import time
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import pytest

from registration.errors import InputError
from workflows.engine.client import QueueClient
from workflows.engine.database import default_url
from workflows.engine.jobs import FlowJob, Job
from workflows.engine.liveness import FileLocks
from workflows.engine.metrics import queue_metrics
from workflows.engine.process import migrate
from workflows.engine.reader import QueueReader
from workflows.farm.status import JobFilter, find_jobs, group_lines, job_lines, require_part, status_lines


class Queue:
    """A queue in a folder."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.url, self.logs = folder, default_url(folder), folder / "logs"
        migrate(self.url)
        self.client, self.reader = QueueClient(self.url), QueueReader(self.url)

    def submit(self, *ids: str) -> None:
        for identity in ids:
            subject, _, name = identity.partition("/")[2].rpartition("/")
            capture = f"/data/{subject.rpartition('/')[2]}/{name}"
            self.client.submit([Job(id=identity, step="register", arguments={"capture": capture})])

    def set(self, identity: str, **columns: object) -> None:
        """Change columns of a row."""
        with closing(sqlite3.connect(self.folder / "queue.sqlite")) as database, database:
            text = ", ".join(f"{name} = :{name}" for name in columns)
            database.execute(
                f"UPDATE workflow_status SET {text} WHERE workflow_uuid = :id", {**columns, "id": identity}
            )

    def run(self, identity: str, executor: str, start_s: float) -> None:
        self.set(identity, status="PENDING", executor_id=executor, started_at_epoch_ms=int(1000 * start_s))

    def end(self, identity: str, start_s: float, end_s: float, *, made: bool = True, failure: object = None) -> None:
        self.set(
            identity,
            status="ERROR" if failure else "SUCCESS",
            started_at_epoch_ms=int(1000 * start_s),
            completed_at=int(1000 * end_s),
            output=json.dumps({"status": "done", "result": {"made": made}}),
            error=json.dumps({"error": failure}) if failure else None,
        )

    def status(self, run: str | None = None) -> str:
        return "\n".join(status_lines(self.reader, run, self.logs))

    def jobs(self, run: str | None = None, limit: int = 0, **chosen: str) -> list[str]:
        """Ids that are listed."""
        return [line.split()[0] for line in job_lines(self.reader, run, JobFilter(**chosen), self.logs, limit)[1:-1]]


@pytest.fixture
def queue(tmp_path: Path) -> Iterator[Queue]:
    queue = Queue(tmp_path)
    yield queue
    queue.client.close()


NOW = time.time()


def test_the_throughput_counts_working_time_from_the_first_start(queue: Queue) -> None:
    queue.submit("r/a/x", "r/b/x", "r/c/x", "r/d/x")
    queue.end("r/a/x", NOW - 5000, NOW - 4764)
    assert queue_metrics(queue.reader).a_day == pytest.approx(86400 / 236)
    queue.end("r/b/x", NOW - 2000, NOW - 1764)  # after a pause, which does not count
    assert queue_metrics(queue.reader).a_day == pytest.approx(86400 / 236)
    queue.end("r/c/x", NOW - 2000, NOW - 1764)  # beside another one
    assert queue_metrics(queue.reader).a_day == pytest.approx(1.5 * 86400 / 236)
    queue.end("r/d/x", NOW - 10, NOW - 9, made=False)  # its result was there
    assert queue_metrics(queue.reader).a_day == pytest.approx(1.5 * 86400 / 236)


def test_the_expected_end_follows_from_what_is_left(queue: Queue) -> None:
    locks = FileLocks(queue.url)
    assert locks.take("host-cpu0")
    queue.submit("r/a/x", "r/b/x", "r/c/x", "r/d/x")
    queue.end("r/a/x", NOW - 500, NOW - 400)
    assert queue_metrics(queue.reader).left_s is None and "expected end" not in queue.status()
    queue.run("r/b/x", "host-cpu0", NOW)
    assert queue_metrics(queue.reader).left_s == pytest.approx(300.0)
    assert "in 5 min, of the 3 captures in the queue" in queue.status()


def test_each_worker_is_shown_with_its_job_and_stage(queue: Queue) -> None:
    held = [FileLocks(queue.url) for _ in range(3)]
    for locks, name in zip(held, ("host-cpu0", "host-cpu1", "host-coordinator0"), strict=True):
        assert locks.take(name)
    queue.submit("r/a/x", "r/b/x")
    now = time.time()  # `NOW` is that of the import, which can be minutes ago
    queue.run("r/a/x", "host-cpu0", now - 200)
    (queue.logs / "r" / "a").mkdir(parents=True)
    lines = [{"time": now, "what": "offsets", "done": 41, "total": 90}, {"time": now, "note": "hello"}]
    (queue.logs / "r" / "a" / "x.jsonl").write_text("\n".join(map(json.dumps, lines)))
    text = queue.status()
    assert "host-cpu0: r/a/x, offsets 41 of 90, for 3 min" in text
    assert "host-cpu1: idle" in text and "host-coordinator0: runs" in text


def test_a_job_of_a_dead_worker_is_interrupted(queue: Queue) -> None:
    queue.submit("r/a/x", "r/b/x")
    queue.run("r/a/x", "host-cpu0", NOW)
    text = queue.status()
    assert "jobs: 2 (1 interrupted, 1 waiting)" in text and "no worker runs" in text and "host-cpu0" not in text
    assert queue.jobs(state="interrupted") == ["r/a/x"] and queue.jobs(state="running") == []


def test_failures_are_grouped_and_their_fix_is_whole(queue: Queue) -> None:
    ids = [f"r/s{n}/x" for n in range(5)]
    queue.submit(*ids)
    fix = "correct it; " * 40 + "the end"
    for n, identity in enumerate(ids):
        record = {"status": "bad input", "what": "The mask is empty", "reason": f"in /d/{n}; {fix}", "fix": fix}
        queue.end(identity, NOW - 2, NOW - 1, failure=record)
    text = queue.status()
    assert text.count("The mask is empty") == 1 and "      5  bad input: The mask is empty" in text
    assert fix in text and "r/s0/x, r/s1/x, r/s2/x and 2 more" in text


def test_jobs_are_filtered(queue: Queue) -> None:
    queue.submit("r/ann/rest", "r/ann/smile", "r/bob/rest", "q/cyd/rest")
    queue.end("r/bob/rest", NOW - 2, NOW - 1, failure={"status": "died", "reason": "was killed by SIGSEGV"})
    queue.end("r/ann/rest", NOW - 2, NOW - 1)
    assert set(queue.jobs()) == {"r/ann/rest", "r/ann/smile", "r/bob/rest", "q/cyd/rest"}
    assert set(queue.jobs(run="r")) == {"r/ann/rest", "r/ann/smile", "r/bob/rest"}
    assert queue.jobs(state="failed") == ["r/bob/rest"] == queue.jobs(text="sigsegv")
    assert set(queue.jobs(subject="ann")) == {"r/ann/rest", "r/ann/smile"}
    assert queue.jobs(subject="ann", state="waiting") == ["r/ann/smile"] == queue.jobs(text="/data/ann/smile")
    assert queue.jobs(text="nothing") == []
    assert len(queue.jobs(limit=2)) == 2
    assert job_lines(queue.reader, None, JobFilter(), queue.logs, 2)[-1] == "2 of 4 jobs; --limit 4 shows all"


def test_typing_errors_are_answered_with_the_nearest_names(queue: Queue) -> None:
    queue.submit("results/ann/rest", "results/bob/rest")
    for call, near in (
        (lambda: require_part(queue.reader, "resutls"), "results"),
        (lambda: require_part(queue.reader, "results/anm"), "results/ann"),
        (lambda: queue.status("result"), "results"),
        (lambda: queue.jobs("rsults"), "results"),
        (lambda: queue.jobs(subject="anne"), "ann"),
        (lambda: find_jobs(queue.reader, "results/ann/rst"), "results/ann/rest"),
    ):
        with pytest.raises(InputError, match="There is no such") as caught:
            call()
        assert caught.value.fix.startswith(f"did you mean {near}?")


def test_an_empty_queue_has_no_names(queue: Queue) -> None:
    with pytest.raises(InputError, match="no such run") as caught:
        require_part(queue.reader, "r")
    assert "the queue has no run" in caught.value.expected


@pytest.mark.parametrize(
    ("typed", "found"),
    [
        ("run/it00/s00001-ann/e001-smile", "run/it00/s00001-ann/e001-smile"),
        ("ann/smile", "run/it00/s00001-ann/e001-smile"),
        ("it00/ann/smile", "run/it00/s00001-ann/e001-smile"),
        ("run/it00/build", "run/it00/build-0123abcd"),
        ("build", "run/it00/build-0123abcd"),
        ("ann", "run/it00/s00001-ann"),
        ("run/it00", "run/it00"),
        ("run", "run"),
    ],
)
def test_ids_are_found_by_what_people_type(queue: Queue, typed: str, found: str) -> None:
    queue.submit("run/it00/s00001-ann/neutral", "run/it00/s00001-ann/e001-smile", "run/it00/s00002-bob/neutral")
    queue.submit("run/it00/build-0123abcd")
    queue.client.submit([FlowJob(id="run", flow="coregister"), FlowJob(id="run/it00/s00001-ann", flow="subject")])
    assert find_jobs(queue.reader, typed)[0] == found


def test_the_latest_of_a_steps_jobs_is_meant(queue: Queue) -> None:
    queue.submit("run/it00/build-0123abcd", "run/it00/build-fedc4567", "run/it00/build-89ab89ab")
    queue.set("run/it00/build-fedc4567", created_at=int(1000 * (NOW + 86_400)))
    assert find_jobs(queue.reader, "run/it00/build")[0] == "run/it00/build-fedc4567"


def test_a_name_of_several_jobs_is_refused_with_their_ids(queue: Queue) -> None:
    queue.submit("run/it00/s00001-ann/neutral", "run/it01/s00001-ann/neutral")
    with pytest.raises(InputError, match="Several jobs") as caught:
        find_jobs(queue.reader, "ann/neutral")
    assert "run/it00/s00001-ann/neutral, run/it01/s00001-ann/neutral" in caught.value.fix


def test_a_round_is_shown_with_its_jobs_failed_ones_first(queue: Queue) -> None:
    queue.submit("run/it00/s00001-ann/neutral", "run/it00/s00002-bob/neutral")
    queue.end("run/it00/s00002-bob/neutral", NOW - 2, NOW - 1, failure={"status": "died", "reason": "it was killed"})
    lines = group_lines(*find_jobs(queue.reader, "run/it00"))
    assert lines == [
        "run/it00: a group; jobs: 2 (1 failed, 1 waiting)",
        "  failed       run/it00/s00002-bob/neutral: died: it was killed",
        "  waiting      run/it00/s00001-ann/neutral",
    ]


@pytest.mark.parametrize(
    "columns",
    [
        {"status": "STRANGE"},
        {"created_at": 10**17, "started_at_epoch_ms": "later", "completed_at": 1e300, "status": "SUCCESS"},
        {"status": "ERROR", "error": json.dumps({"error": {"status": [1], "reason": {}, "what": 3, "fix": None}})},
        {"status": "PENDING", "executor_id": "../../etc/passwd"},
        {"status": "PENDING", "executor_id": b"\xff", "queue_name": b"\xfe", "application_version": b"\x00"},
        {"queue_name": "other", "application_version": "x" * 100},
    ],
)
@pytest.mark.parametrize("arguments", [{"capture": 3, "out": ["x"]}, "text", None])
def test_rows_that_others_wrote_are_shown_too(queue: Queue, columns: dict[str, object], arguments: object) -> None:
    queue.submit("r/a/x")
    queue.set("r/a/x", **columns)
    with closing(sqlite3.connect(queue.folder / "queue.sqlite")) as database, database:
        inputs = json.dumps({"args": [{"step": [], "arguments": arguments}], "kwargs": {"queue": "gpu"}})
        database.execute("UPDATE workflow_input SET inputs = ?", (inputs,))
        database.execute("INSERT OR REPLACE INTO gnmreg_workers VALUES ('w', '[1, {'), ('v', '{\"queues\": 3}')")
    assert "jobs: 1" in queue.status() and queue.jobs() == ["r/a/x"]
    assert "r/a/x" in "\n".join(group_lines(*find_jobs(queue.reader, "r")))
