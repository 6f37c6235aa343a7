"""Fault injection into the engine, on SQLite and on a real PostgreSQL: `make test-durability`.

Light steps stand in for registrations; the tests check who runs them, how often, and that none is lost.
"""

import os
import signal
import time
from pathlib import Path

import pytest
import sqlalchemy as sa

from bench.support.postgres_server import Server
from tests.workflows.farm.harness import QUICK, Farm, alive, children_of, open_farm
from workflows.engine.alive import lock_key
from workflows.engine.database import checked_url, engine
from workflows.engine.jobs import FlowJob, Job
from workflows.engine.metrics import queue_metrics
from workflows.records.store import Store

pytestmark = pytest.mark.durability
RESULTS = Path(os.environ.get("GNMREG_DURABILITY", "build/durability.txt"))


def work(farm: Farm, identity: str, seconds: float = 0.0) -> Job:
    arguments = {"store": f"{farm.folder}/store", "key": identity, "seconds": seconds, "trace": str(farm.trace)}
    return Job(id=identity, step="work", arguments=arguments)


def wait_for_begin(farm: Farm, identity: str, times: int = 1) -> float:
    return farm.wait_until(lambda: farm.lines(f"begin {identity}").total() >= times, what=f"{identity} to begin")


def executor(farm: Farm, identity: str) -> str:
    return str(farm.reader.rows([identity])[identity].executor)


def test_the_job_of_a_killed_worker_moves_to_a_peer(farm: Farm) -> None:
    farm.start("w0", "w1")
    farm.queue.submit([work(farm, "run/a", seconds=3.0)])
    wait_for_begin(farm, "run/a")
    dead = executor(farm, "run/a")
    child = children_of(farm.processes[dead].pid)
    farm.kill(dead)
    print(f"begun on a peer after {wait_for_begin(farm, 'run/a', 2):.1f} s")
    assert not any(map(alive, child))
    farm.wait_for_end("run/a")
    assert farm.job("run/a")["state"] == "done" and executor(farm, "run/a") != dead
    assert farm.lines("end") == {"end run/a": 1}


def test_a_restarted_worker_resumes_its_job(farm: Farm) -> None:
    """The only worker, restarted under the same executor id, resumes its job at once."""
    farm.start("w0")
    farm.queue.submit([work(farm, "run/a", seconds=1.0)])
    wait_for_begin(farm, "run/a")
    farm.kill("w0")
    farm.start("w0")
    farm.wait_for_end("run/a")
    assert farm.lines("end") == {"end run/a": 1}


def test_the_flow_of_a_killed_coordinator_ends(farm: Farm) -> None:
    farm.start("w0", "c0", "c1")
    arguments = {"subjects": 2, "expressions": 2, "folder": str(farm.folder), "seconds": 0.3}
    farm.queue.submit([FlowJob(id="run", flow="graph", queue="driver", arguments=arguments)])
    wait_for_begin(farm, "run")
    farm.kill(executor(farm, "run"))
    farm.wait_for_end("run")
    assert farm.job("run")["result"] == {"subjects": 2, "rebuilt": 1}
    assert set(farm.lines().values()) == {1} and len(farm.lines("end")) == 9


def test_a_frozen_worker_keeps_its_job(farm: Farm) -> None:
    farm.start("w0", "w1")
    farm.queue.submit([work(farm, "run/a", seconds=1.0)])
    wait_for_begin(farm, "run/a")
    frozen = executor(farm, "run/a")
    farm.signal(frozen, signal.SIGSTOP)
    time.sleep(8 * QUICK["release_s"])
    assert farm.job("run/a")["state"] == "running" and executor(farm, "run/a") == frozen
    farm.signal(frozen, signal.SIGCONT)
    farm.wait_for_end("run/a")
    assert farm.job("run/a")["state"] == "done"
    assert farm.lines() == {"begin run/a": 1, "end run/a": 1}


def test_a_frozen_worker_whose_connection_broke_is_fenced(farm: Farm) -> None:
    """As after a network failure: considered dead, the worker resumes and must not alter its successor's result."""
    if farm.url.startswith("sqlite"):
        pytest.skip("a file's lock cannot be lost")
    farm.start("w0", "w1")
    farm.queue.submit([work(farm, "run/a", seconds=4.0)])
    wait_for_begin(farm, "run/a")
    frozen = executor(farm, "run/a")
    farm.signal(frozen, signal.SIGSTOP)
    with engine(checked_url(farm.url)).connect() as connection:
        connection.execute(
            sa.text("SELECT pg_terminate_backend(pid) FROM pg_locks WHERE locktype = 'advisory' AND objid = :key"),
            {"key": lock_key(frozen) % 2**32},
        )
    wait_for_begin(farm, "run/a", 2)
    farm.signal(frozen, signal.SIGCONT)
    farm.wait_for_end("run/a")
    assert farm.job("run/a")["state"] == "done" and executor(farm, "run/a") != frozen
    farm.queue.submit([work(farm, f"run/b{n}") for n in range(6)])
    farm.wait_for_end(*(f"run/b{n}" for n in range(6)))
    report = Store(farm.folder / "store").verify()
    assert report.is_sound and report.artifacts == 7


def test_a_poison_job_becomes_a_dead_letter(farm: Farm) -> None:
    farm.start("w0")
    farm.queue.submit([Job(id="run/poison", step="poison", arguments={"trace": str(farm.trace)})])
    for time_ in range(1, 7):
        wait_for_begin(farm, "poison", time_)
        farm.wait_until(lambda: not farm.runs("w0"), what="w0 to die")
        farm.kill("w0")
        farm.start("w0")
    farm.wait_for_end("run/poison")
    assert farm.job("run/poison")["failure"] == {"status": "dead", "reason": "killed its worker every time"}
    assert farm.lines("begin poison").total() == 6
    farm.queue.submit([work(farm, "run/a")])
    farm.wait_for_end("run/a")
    assert farm.job("run/a")["state"] == "done"


def test_a_job_that_holds_the_interpreter_runs_once(farm: Farm) -> None:
    farm.start("w0", "w1")
    arguments = {"seconds": 20, "trace": str(farm.trace)}
    farm.queue.submit([Job(id="run/gil", step="hold_gil", arguments=arguments)])
    farm.wait_for_end("run/gil")
    assert farm.job("run/gil")["result"]["result"] == "held"
    assert farm.lines() == {"begin gil": 1, "end gil": 1}


def test_cancel_stops_a_flow_and_all_its_jobs(farm: Farm) -> None:
    farm.start("w0", "w1", "c0")
    arguments = {"subjects": 3, "expressions": 2, "folder": str(farm.folder), "seconds": 600.0}
    farm.queue.submit([FlowJob(id="run", flow="graph", queue="driver", arguments=arguments)])
    farm.wait_until(lambda: farm.lines("begin run").total() == 2)
    assert farm.queue.cancel("run") == 7  # the driver, three subjects and their neutrals
    pids = [int(line.split()[-1]) for line in farm.trace.read_text().splitlines()]
    farm.wait_until(lambda: not any(map(alive, pids)), what="the children to die")
    farm.queue.submit([work(farm, "next/a")])
    farm.wait_for_end("next/a")
    time.sleep(3)
    assert farm.job("run")["state"] == "cancelled"
    assert farm.reader.counts("run") == {"cancelled": 6}
    assert farm.lines("begin run").total() == 2 and not farm.lines("end run")


def test_jobs_survive_a_restart_of_postgres(postgres: Server, tmp_path: Path) -> None:
    """All locks are lost at once while dead executors are detected: none is considered dead, each job runs once."""
    timeouts = {"poll_s": 0.3, "release_s": 3.0, "uptime_s": 8.0}
    with open_farm(tmp_path, postgres.url, timeouts) as farm:
        farm.start("w0", "w1", "c0")
        arguments = {"subjects": 3, "expressions": 2, "folder": str(farm.folder), "seconds": 1.0}
        farm.queue.submit([FlowJob(id="run", flow="graph", queue="driver", arguments=arguments)])
        farm.wait_until(lambda: farm.lines("end run").total() >= 2)
        postgres.stop()
        time.sleep(5)  # jobs end meanwhile
        postgres.start()
        farm.wait_for_end("run")
        assert farm.job("run")["result"] == {"subjects": 3, "rebuilt": 1}
        assert set(farm.lines().values()) == {1} and len(farm.lines("end")) == 13
        assert all(farm.runs(name) for name in farm.processes)
        assert "is gone" not in "".join(map(farm.output, farm.processes))
        farm.kill("w0")  # dead executors are still detected
        farm.queue.submit([work(farm, f"more/{n}") for n in range(4)])
        farm.wait_for_end(*(f"more/{n}" for n in range(4)))


def test_a_graph_survives_killed_workers_and_coordinators(farm: Farm) -> None:
    """10 subjects x 5 expressions, 3 workers and 2 coordinators killed: no job lost, at most one repeated."""
    farm.start("w0", "w1", "c0")
    subjects, expressions = 10, 5
    arguments = {"subjects": subjects, "expressions": expressions, "folder": str(farm.folder), "seconds": 0.4}
    farm.queue.submit([FlowJob(id="run", flow="graph", queue="driver", arguments=arguments)])
    total = subjects * (expressions + 2) + 1
    for fraction, name in ((0.1, "w0"), (0.25, "c0"), (0.4, "w1"), (0.6, "c0"), (0.8, "w0")):
        farm.wait_until(
            lambda fraction=fraction: farm.lines("end run").total() >= fraction * total, what=f"{fraction:.0%}"
        )
        farm.kill(name)
        farm.start(name)
    farm.wait_for_end("run")
    counts = farm.reader.counts("run", kind="job")
    ends, begins = farm.lines("end run"), farm.lines("begin run")
    lost, repeated = total - len(ends), ends.total() - len(ends)
    report = Store(farm.folder / "store").verify()
    kind = farm.url.partition(":")[0].replace("postgresql", "postgres")
    RESULTS.parent.mkdir(parents=True, exist_ok=True)
    with RESULTS.open("a") as file:
        print(f"{kind}: {total} jobs, {begins.total() - len(begins)} begun again after a kill", file=file)
        print(f"{kind} lost {lost} repeated {repeated}", file=file)
    assert counts == {"done": total}
    assert farm.job("run")["result"] == {"subjects": subjects, "rebuilt": 1}
    assert lost == 0 and repeated <= 1
    assert report.is_sound and report.artifacts == total


def test_a_job_outside_a_workers_roots_is_left_to_another(farm: Farm) -> None:
    elsewhere = farm.folder.parent / f"{farm.folder.name}-elsewhere"
    elsewhere.mkdir()
    farm.settings["roots"] = {"w1": [str(elsewhere)]}
    farm.start("w0")
    farm.queue.submit([Job(id="run/b", step="work", arguments={"store": str(elsewhere), "key": "b"}, priority=1)])
    farm.queue.submit([work(farm, "run/a")])
    farm.wait_for_end("run/a")
    farm.wait_until(lambda: queue_metrics(farm.reader).uncovered == ("run/b",))
    assert farm.job("run/b")["state"] == "waiting"
    farm.start("w1")
    farm.wait_for_end("run/b")
    assert farm.job("run/b")["state"] == "done" and executor(farm, "run/b") == "w1"
