"""A farm on SQLite, in short; test_durability.py has the rest."""

import signal
from collections.abc import Iterator

import pytest

from registration.errors import InputError
from tests.workflows.farm.harness import Farm, farm
from workflows.engine.jobs import FlowJob, Job


@pytest.fixture(scope="module")
def small(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Farm]:
    """Two workers and a coordinator, shared: starting them takes most of the time."""
    with farm(tmp_path_factory.mktemp("farm")) as made:
        made.start("w0", "w1", "c0")
        yield made


def work(small: Farm, identity: str, seconds: float = 0.0, **settings: object) -> Job:
    arguments = {"store": f"{small.folder}/store", "key": identity, "seconds": seconds, "trace": str(small.trace)}
    return Job(id=identity, step="work", arguments=arguments, **settings)


def test_jobs_that_fail_leave_workers_alive(small: Farm) -> None:
    foreign = {"store": "/etc", "key": "k"}
    small.queue.submit(
        [
            Job(id="bad/input", step="refuse"),
            Job(id="bad/step", step="os:system"),
            Job(id="bad/place", step="work", arguments=foreign),
            Job(id="bad/crash", step="crash"),
            Job(id="bad/fail", step="fail", arguments={"trace": str(small.trace)}),
            Job(id="bad/brief", step="brief", arguments={"store": f"{small.folder}/s", "key": "k", "seconds": 60.0}),
        ]
    )
    names = ("input", "step", "place", "crash", "fail", "brief")
    small.ends(*(f"bad/{name}" for name in names))
    told = {name: small.job(f"bad/{name}")["failure"] for name in names}
    assert {name: (record["status"], record["attempts"]) for name, record in told.items()} == {
        "input": ("bad input", 1),
        "step": ("refused", 1),
        "place": ("refused", 1),
        "crash": ("died", 3),
        "fail": ("failed", 3),
        "brief": ("timed out", 1),
    }
    assert small.runs("w0") and small.runs("w1")
    figures = small.reader.metrics("bad")
    assert figures.counts == {"failed": 6} and sum(figures.failures.values()) == 6
    assert "secret" not in str(figures) + small.said("w0") + small.said("w1")


def test_a_killed_workers_job_goes_to_a_peer(small: Farm) -> None:
    small.queue.submit([work(small, "kill/a", seconds=1.5)])
    small.until(lambda: small.lines("begin kill/a").total() == 1)
    small.until(lambda: small.reader.rows(["kill/a"])["kill/a"].executor is not None)
    small.kill(str(small.reader.rows(["kill/a"])["kill/a"].executor))
    small.ends("kill/a")
    assert small.job("kill/a")["state"] == "done"
    assert small.lines("end kill/a") == {"end kill/a": 1}
    small.start(*({"w0", "w1"} - set(small.processes)))


def test_a_flow_is_done_once_and_again_is_nothing(small: Farm) -> None:
    arguments = {"subjects": 2, "expressions": 2, "folder": str(small.folder), "seconds": 0.0}
    flow = FlowJob(id="flow", flow="graph", queue="driver", arguments=arguments)
    for _ in range(2):
        small.queue.submit([flow])
        small.ends("flow")
    assert small.job("flow")["result"] == {"subjects": 2, "rebuilt": 1}
    assert set(small.lines("end flow").values()) == {1} and len(small.lines("end flow")) == 9
    assert small.reader.counts("flow") == {"done": 11}


def test_a_batch_ends_when_the_last_of_its_jobs_does(small: Farm) -> None:
    small.queue.submit([work(small, f"many/ann/e{n}", seconds=0.4) for n in range(4)])
    small.queue.submit([Job(id="many/bob/e0", step="refuse")])
    small.queue.submit([FlowJob(id="many", flow="batch", queue="driver")])
    small.ends("many")
    assert small.job("many")["result"] == {"done": 4, "failed": 1}


def test_what_failed_is_retried_in_place(small: Farm) -> None:
    blocked = small.folder / "store2"
    blocked.write_text("in the way")
    arguments = {"store": str(blocked), "key": "k"}
    small.queue.submit([Job(id="again/a", step="work", arguments=arguments), work(small, "again/b")])
    small.ends("again/a", "again/b")
    assert small.job("again/a")["failure"]["status"] == "failed"
    blocked.unlink()
    assert small.queue.retry("again") == ["again/a"]
    small.ends("again/a")
    assert small.job("again/a")["state"] == "done"
    assert small.queue.retry("again") == []


def test_cancelling_stops_what_runs_and_what_waits(small: Farm) -> None:
    small.queue.submit([work(small, f"stop/{n}", seconds=60.0) for n in range(4)])
    small.until(lambda: small.lines("begin stop").total() == 2)
    assert small.queue.cancel("stop") == 4
    small.queue.submit([work(small, "after/a")])
    small.ends("after/a")
    assert small.reader.counts("stop") == {"cancelled": 4}
    assert small.lines("begin stop").total() == 2 and not small.lines("end stop")


def test_forgetting_needs_an_end(small: Farm) -> None:
    small.queue.submit([work(small, "old/it00/a"), work(small, "old/it01/a")])
    small.ends("old/it00/a", "old/it01/a")
    assert small.queue.forget("old/it00") == 1
    assert small.reader.counts("old") == {"done": 1}
    small.queue.submit([work(small, "old/it02/a", seconds=1.0)])
    with pytest.raises(InputError, match="have not ended"):
        small.queue.forget("old")
    small.ends("old/it02/a")


def test_a_place_is_taken_once_and_sigterm_ends(small: Farm) -> None:
    kept = small.processes["w1"]
    with pytest.raises(AssertionError, match="Another process has this executor id"):
        small.start("w1")
    small.processes["w1"] = kept
    small.start("w2")
    process = small.processes["w2"]
    process.send_signal(signal.SIGTERM)
    assert process.wait(timeout=20) == 0
    del small.processes["w2"]
