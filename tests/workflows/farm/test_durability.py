"""The engine under fire, on SQLite and on a real PostgreSQL: `make test-durability`.

Light steps stand for registrations: what is tried is who does them, how often, and whether one is lost.
"""

import os
import re
import signal
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
import sqlalchemy as sa

from bench.support.postgres_server import Server, programs, server
from tests.workflows.farm.harness import QUICK, Farm, alive, children_of, farm
from workflows.engine.database import checked_url, engine
from workflows.engine.jobs import FlowJob, Job
from workflows.records.store import Store

pytestmark = pytest.mark.durability
RESULTS = Path(os.environ.get("GNMREG_DURABILITY", "build/durability.txt"))


@pytest.fixture(scope="session")
def postgres() -> Iterator[Server]:
    if programs() is None:
        pytest.fail("no PostgreSQL here: sudo apt-get install -y postgresql")
    with server() as made:
        yield made


@pytest.fixture(params=["sqlite", "postgres"])
def made(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Farm]:
    url = None
    if request.param == "postgres":
        base = request.getfixturevalue("postgres").url
        name = "q" + re.sub(r"\W", "", request.node.name).lower()[-40:]
        connection = engine(checked_url(base)).connect().execution_options(isolation_level="AUTOCOMMIT")
        connection.execute(sa.text(f"CREATE DATABASE {name}"))
        connection.close()
        url = base.rpartition("/")[0] + f"/{name}"
    with farm(tmp_path, url) as farm_:
        yield farm_


def work(made: Farm, identity: str, seconds: float = 0.0) -> Job:
    arguments = {"store": f"{made.folder}/store", "key": identity, "seconds": seconds, "trace": str(made.trace)}
    return Job(id=identity, step="work", arguments=arguments)


def begun(made: Farm, identity: str, times: int = 1) -> float:
    return made.until(lambda: made.lines(f"begin {identity}").total() >= times, what=f"{identity} to begin")


def executor(made: Farm, identity: str) -> str:
    return str(made.reader.rows([identity])[identity].executor)


def test_a_killed_worker(made: Farm) -> None:
    made.start("w0", "w1")
    made.queue.submit([work(made, "run/a", seconds=3.0)])
    begun(made, "run/a")
    dead = executor(made, "run/a")
    child = children_of(made.processes[dead].pid)
    made.kill(dead)
    print(f"begun on a peer after {begun(made, 'run/a', 2):.1f} s")
    assert not any(map(alive, child))
    made.ends("run/a")
    assert made.job("run/a")["state"] == "done" and executor(made, "run/a") != dead
    assert made.lines("end") == {"end run/a": 1}


def test_a_killed_worker_that_comes_back(made: Farm) -> None:
    """Alone, under its own name: it takes up its job at once."""
    made.start("w0")
    made.queue.submit([work(made, "run/a", seconds=1.0)])
    begun(made, "run/a")
    made.kill("w0")
    made.start("w0")
    made.ends("run/a")
    assert made.lines("end") == {"end run/a": 1}


def test_a_killed_driver(made: Farm) -> None:
    made.start("w0", "c0", "c1")
    arguments = {"subjects": 2, "expressions": 2, "folder": str(made.folder), "seconds": 0.3}
    made.queue.submit([FlowJob(id="run", flow="graph", queue="driver", arguments=arguments)])
    begun(made, "run")
    made.kill(executor(made, "run"))
    made.ends("run")
    assert made.job("run")["result"] == {"subjects": 2, "rebuilt": 1}
    assert set(made.lines().values()) == {1} and len(made.lines("end")) == 9


def test_a_frozen_worker_is_not_taken_for_dead(made: Farm) -> None:
    made.start("w0", "w1")
    made.queue.submit([work(made, "run/a", seconds=1.0)])
    begun(made, "run/a")
    frozen = executor(made, "run/a")
    made.signal(frozen, signal.SIGSTOP)
    time.sleep(8 * QUICK["release_s"])
    assert made.job("run/a")["state"] == "running" and executor(made, "run/a") == frozen
    made.signal(frozen, signal.SIGCONT)
    made.ends("run/a")
    assert made.job("run/a")["state"] == "done"
    assert made.lines() == {"begin run/a": 1, "end run/a": 1}


def test_a_frozen_worker_whose_connection_broke_is_fenced(made: Farm) -> None:
    """What a cut network does: it is taken for dead, thaws, and must not harm what its successor did."""
    if made.url.startswith("sqlite"):
        pytest.skip("a file's lock cannot be lost")
    made.start("w0", "w1")
    made.queue.submit([work(made, "run/a", seconds=4.0)])
    begun(made, "run/a")
    frozen = executor(made, "run/a")
    made.signal(frozen, signal.SIGSTOP)
    with engine(checked_url(made.url)).connect() as connection:
        connection.execute(
            sa.text("SELECT pg_terminate_backend(pid) FROM pg_locks WHERE locktype = 'advisory' AND objid = :key"),
            {"key": _key(frozen)},
        )
    begun(made, "run/a", 2)
    made.signal(frozen, signal.SIGCONT)
    made.ends("run/a")
    assert made.job("run/a")["state"] == "done" and executor(made, "run/a") != frozen
    made.queue.submit([work(made, f"run/b{n}") for n in range(6)])
    made.ends(*(f"run/b{n}" for n in range(6)))
    found = Store(made.folder / "store").verify()
    assert found.is_sound and found.artifacts == 7


def _key(name: str) -> int:
    from workflows.engine.liveness import _key

    return _key(name) % 2**32


def test_a_poison_job_becomes_a_dead_letter(made: Farm) -> None:
    made.start("w0")
    made.queue.submit([Job(id="run/poison", step="poison", arguments={"trace": str(made.trace)})])
    for time_ in range(1, 7):
        begun(made, "poison", time_)
        made.until(lambda: not made.runs("w0"), what="w0 to die")
        made.kill("w0")
        made.start("w0")
    made.ends("run/poison")
    assert made.job("run/poison")["failure"] == {"status": "dead", "reason": "killed its worker every time"}
    assert made.lines("begin poison").total() == 6
    made.queue.submit([work(made, "run/a")])
    made.ends("run/a")
    assert made.job("run/a")["state"] == "done"


def test_a_job_that_holds_the_interpreter_runs_once(made: Farm) -> None:
    made.start("w0", "w1")
    arguments = {"seconds": 20, "trace": str(made.trace)}
    made.queue.submit([Job(id="run/gil", step="hold_gil", arguments=arguments)])
    made.ends("run/gil")
    assert made.job("run/gil")["result"]["result"] == "held"
    assert made.lines() == {"begin gil": 1, "end gil": 1}


def test_cancelling_a_tree(made: Farm) -> None:
    made.start("w0", "w1", "c0")
    arguments = {"subjects": 3, "expressions": 2, "folder": str(made.folder), "seconds": 600.0}
    made.queue.submit([FlowJob(id="run", flow="graph", queue="driver", arguments=arguments)])
    made.until(lambda: made.lines("begin run").total() == 2)
    assert made.queue.cancel("run") == 7  # the driver, three subjects and their neutrals
    pids = [int(line.split()[-1]) for line in made.trace.read_text().splitlines()]
    made.until(lambda: not any(map(alive, pids)), what="the children to die")
    made.queue.submit([work(made, "next/a")])
    made.ends("next/a")
    time.sleep(3)
    assert made.job("run")["state"] == "cancelled"
    assert made.reader.counts("run") == {"cancelled": 6}
    assert made.lines("begin run").total() == 2 and not made.lines("end run")


def test_postgres_restarts(postgres: Server, tmp_path: Path) -> None:
    """All locks are lost at once, with the detector on: nobody is taken for dead, what runs runs once."""
    timeouts = {"poll_s": 0.3, "release_s": 3.0, "uptime_s": 8.0}
    with farm(tmp_path, postgres.url, timeouts) as made:
        made.start("w0", "w1", "c0")
        arguments = {"subjects": 3, "expressions": 2, "folder": str(made.folder), "seconds": 1.0}
        made.queue.submit([FlowJob(id="run", flow="graph", queue="driver", arguments=arguments)])
        made.until(lambda: made.lines("end run").total() >= 2)
        postgres.stop()
        time.sleep(5)  # jobs end meanwhile
        postgres.start()
        made.ends("run")
        assert made.job("run")["result"] == {"subjects": 3, "rebuilt": 1}
        assert set(made.lines().values()) == {1} and len(made.lines("end")) == 13
        assert all(made.runs(name) for name in made.processes)
        assert "is gone" not in "".join(map(made.said, made.processes))
        made.kill("w0")  # and it still finds the dead
        made.queue.submit([work(made, f"more/{n}") for n in range(4)])
        made.ends(*(f"more/{n}" for n in range(4)))


def test_a_graph_with_kills_in_the_middle(made: Farm) -> None:
    """10 subjects x 5 expressions, 3 workers and 2 drivers killed: nothing lost, at most one piece of work repeated."""
    made.start("w0", "w1", "c0")
    subjects, expressions = 10, 5
    arguments = {"subjects": subjects, "expressions": expressions, "folder": str(made.folder), "seconds": 0.4}
    made.queue.submit([FlowJob(id="run", flow="graph", queue="driver", arguments=arguments)])
    total = subjects * (expressions + 2) + 1
    for share, name in ((0.1, "w0"), (0.25, "c0"), (0.4, "w1"), (0.6, "c0"), (0.8, "w0")):
        made.until(lambda share=share: made.lines("end run").total() >= share * total, what=f"{share:.0%}")
        made.kill(name)
        made.start(name)
    made.ends("run")
    counts = made.reader.counts("run", kind="job")
    ends, begins = made.lines("end run"), made.lines("begin run")
    lost, repeated = total - len(ends), ends.total() - len(ends)
    found = Store(made.folder / "store").verify()
    kind = made.url.partition(":")[0].replace("postgresql", "postgres")
    RESULTS.parent.mkdir(parents=True, exist_ok=True)
    with RESULTS.open("a") as file:
        print(f"{kind}: {total} jobs, {begins.total() - len(begins)} begun again after a kill", file=file)
        print(f"{kind} lost {lost} repeated {repeated}", file=file)
    assert counts == {"done": total}
    assert made.job("run")["result"] == {"subjects": subjects, "rebuilt": 1}
    assert lost == 0 and repeated <= 1
    assert found.is_sound and found.artifacts == total
