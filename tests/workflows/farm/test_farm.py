"""A farm on SQLite: the fast subset of test_durability.py."""

import signal
from collections.abc import Iterator

import pytest

from registration.errors import InputError
from tests.workflows.farm.harness import Farm, open_farm
from workflows.engine.jobs import FlowJob, Job
from workflows.engine.metrics import QueueMetrics, queue_metrics
from workflows.farm.status import status_lines


@pytest.fixture(scope="module")
def farm(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Farm]:
    """Two workers and a coordinator, shared by the tests, as starting them takes most of the time."""
    with open_farm(tmp_path_factory.mktemp("farm")) as farm:
        farm.start("w0", "w1", "c0")
        yield farm


def work(farm: Farm, identity: str, seconds: float = 0.0, **settings: object) -> Job:
    arguments = {"store": f"{farm.folder}/store", "key": identity, "seconds": seconds, "trace": str(farm.trace)}
    return Job(id=identity, step="work", arguments=arguments, **settings)


def test_jobs_that_fail_leave_workers_alive(farm: Farm) -> None:
    foreign = {"store": "file:///etc?x", "key": "k"}
    farm.queue.submit(
        [
            Job(id="bad/input", step="refuse"),
            Job(id="bad/step", step="os:system"),
            Job(id="bad/location", step="work", arguments=foreign),
            Job(id="bad/crash", step="crash"),
            Job(id="bad/fail", step="fail", arguments={"trace": str(farm.trace)}),
            Job(id="bad/brief", step="brief", arguments={"store": f"{farm.folder}/s", "key": "k", "seconds": 60.0}),
        ]
    )
    names = ("input", "step", "location", "crash", "fail", "brief")
    farm.wait_for_end(*(f"bad/{name}" for name in names))
    failures = {name: farm.job(f"bad/{name}")["failure"] for name in names}
    assert {name: (record["status"], record["attempts"]) for name, record in failures.items()} == {
        "input": ("bad input", 1),
        "step": ("refused", 1),
        "location": ("refused", 1),
        "crash": ("died", 3),
        "fail": ("failed", 3),
        "brief": ("timed out", 1),
    }
    assert farm.runs("w0") and farm.runs("w1")
    metrics = queue_metrics(farm.reader, "bad")
    assert metrics.counts == {"failed": 6} and sum(len(kind.jobs) for kind in metrics.failures) == 6
    assert "secret" not in str(metrics) + farm.output("w0") + farm.output("w1")


def test_the_job_of_a_killed_worker_moves_to_a_peer(farm: Farm) -> None:
    farm.queue.submit([work(farm, "kill/a", seconds=1.5)])
    farm.wait_until(lambda: farm.lines("begin kill/a").total() == 1)
    farm.wait_until(lambda: farm.reader.rows(["kill/a"])["kill/a"].executor is not None)
    farm.kill(str(farm.reader.rows(["kill/a"])["kill/a"].executor))
    farm.wait_for_end("kill/a")
    assert farm.job("kill/a")["state"] == "done"
    assert farm.lines("end kill/a") == {"end kill/a": 1}
    farm.start(*({"w0", "w1"} - set(farm.processes)))


def test_a_flow_submitted_twice_runs_once(farm: Farm) -> None:
    arguments = {"subjects": 2, "expressions": 2, "folder": str(farm.folder), "seconds": 0.0}
    flow = FlowJob(id="flow", flow="graph", queue="driver", arguments=arguments)
    for _ in range(2):
        farm.queue.submit([flow])
        farm.wait_for_end("flow")
    assert farm.job("flow")["result"] == {"subjects": 2, "rebuilt": 1}
    assert set(farm.lines("end flow").values()) == {1} and len(farm.lines("end flow")) == 9
    assert farm.reader.counts("flow") == {"done": 11}


def test_a_batch_ends_with_the_last_of_its_jobs(farm: Farm) -> None:
    farm.queue.submit([work(farm, f"many/ann/e{n}", seconds=0.4) for n in range(4)])
    farm.queue.submit([Job(id="many/bob/e0", step="refuse")])
    farm.queue.submit([FlowJob(id="many", flow="batch", queue="driver")])
    farm.wait_for_end("many")
    assert farm.job("many")["result"] == {"done": 4, "failed": 1}


def test_retry_requeues_failed_jobs_only(farm: Farm) -> None:
    blocked = farm.folder / "store2"
    blocked.write_text("in the way")
    arguments = {"store": str(blocked), "key": "k"}
    farm.queue.submit([Job(id="again/a", step="work", arguments=arguments), work(farm, "again/b")])
    farm.wait_for_end("again/a", "again/b")
    assert farm.job("again/a")["failure"]["status"] == "failed"
    blocked.unlink()
    assert farm.queue.retry("again") == ["again/a"]
    farm.wait_for_end("again/a")
    assert farm.job("again/a")["state"] == "done"
    assert farm.queue.retry("again") == []


def test_cancel_stops_running_and_waiting_jobs(farm: Farm) -> None:
    farm.queue.submit([work(farm, f"stop/{n}", seconds=60.0) for n in range(4)])
    farm.wait_until(lambda: farm.lines("begin stop").total() == 2)
    assert farm.queue.cancel("stop") == 4
    farm.queue.submit([work(farm, "after/a")])
    farm.wait_for_end("after/a")
    assert farm.reader.counts("stop") == {"cancelled": 4}
    assert farm.lines("begin stop").total() == 2 and not farm.lines("end stop")
    assert "Traceback" not in farm.output("w0") + farm.output("w1")


def test_forget_refuses_unfinished_jobs(farm: Farm) -> None:
    farm.queue.submit([work(farm, "old/it00/a"), work(farm, "old/it01/a")])
    farm.wait_for_end("old/it00/a", "old/it01/a")
    assert farm.queue.forget("old/it00") == 1
    assert farm.reader.counts("old") == {"done": 1}
    farm.queue.submit([work(farm, "old/it02/a", seconds=1.0)])
    with pytest.raises(InputError, match="have not ended"):
        farm.queue.forget("old")
    farm.wait_for_end("old/it02/a")


@pytest.mark.slow
def test_an_executor_id_is_exclusive_and_sigterm_ends_a_worker(farm: Farm) -> None:
    kept = farm.processes["w1"]
    with pytest.raises(AssertionError, match="Another process has this executor id"):
        farm.start("w1")
    farm.processes["w1"] = kept
    farm.start("w2")
    process = farm.processes["w2"]
    process.send_signal(signal.SIGTERM)
    assert process.wait(timeout=20) == 0
    del farm.processes["w2"]


def test_a_worker_leaves_jobs_outside_its_roots_to_others(farm: Farm) -> None:
    """More of them than a page, before those that it takes; nobody's are reported, until a worker takes them."""
    elsewhere = farm.folder.parent / f"{farm.folder.name}-elsewhere"
    elsewhere.mkdir()
    arguments = {"store": str(elsewhere), "key": "k"}
    ids = [f"roots/{n:03d}" for n in range(120)]
    farm.queue.submit([Job(id=i, step="work", arguments={**arguments, "key": i}, priority=1) for i in ids])
    farm.queue.submit([work(farm, "roots/own")])
    farm.wait_for_end("roots/own")
    assert farm.reader.counts("roots") == {"waiting": 120, "done": 1}

    def metrics() -> QueueMetrics:
        return queue_metrics(farm.reader, "roots")

    farm.wait_until(lambda: len(metrics().uncovered) == 120)
    assert "120 jobs lie outside the roots of all workers, e.g. roots/000" in "\n".join(
        status_lines(farm.reader, "roots", farm.folder / "logs")
    )
    farm.settings["roots"] = {"w3": [str(elsewhere)]}
    farm.start("w3")
    farm.wait_until(lambda: not metrics().uncovered)
    farm.wait_for_end(*ids[:2])
    assert {farm.reader.rows([i])[i].executor for i in ids[:2]} == {"w3"}
    assert farm.queue.cancel("roots") > 0
    farm.kill("w3")
