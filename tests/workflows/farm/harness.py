"""Farms for tests: processes to start, kill and freeze, and their shared queue."""

import json
import signal
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from tests.conftest import ROOT
from workflows.engine.client import QueueClient
from workflows.engine.metrics import queue_metrics
from workflows.engine.process import migrate
from workflows.engine.reader import QueueReader

QUICK = {"poll_s": 0.3, "release_s": 1.0, "uptime_s": 0.0}
LIGHT = {"steps": "tests.workflows.farm.steps", "flows": "tests.workflows.farm.flows"}
TRUE_ROUNDS = dict.fromkeys(LIGHT, "tests.workflows.farm.true_steps")


def interruptible() -> None:
    """Restore SIGINT in a child before it starts; a shell ignores it in background processes, tests too."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)


class Farm:
    """A queue and its processes, named by their executor ids."""

    def __init__(
        self, folder: Path, url: str, timeouts: dict[str, float] | None = None, work: dict[str, str] = LIGHT
    ) -> None:
        """`work`: the modules with `STEPS` and with `FLOWS`."""
        self.folder, self.url = folder, url
        self.settings: dict[str, Any] = {"timeouts": timeouts or QUICK, **work}
        self.processes: dict[str, subprocess.Popen[bytes]] = {}
        self.trace = folder / "trace.txt"
        migrate(url)
        self.queue, self.reader = QueueClient(url), QueueReader(url)

    def start(self, *names: str) -> None:
        """Start workers, and coordinators for names that begin with "c"; return when all of them take jobs."""
        before = {name: self.output(name).count("takes jobs") for name in names}
        for name in names:
            kind = "coordinator" if name.startswith("c") else "worker"
            with (self.folder / f"{name}.out").open("ab") as out:
                self.processes[name] = subprocess.Popen(
                    [sys.executable, "-m", "tests.workflows.farm.process", kind, name, self.url, str(self.folder)]
                    + [json.dumps(self.settings)],
                    cwd=ROOT,
                    stdout=out,
                    stderr=out,
                )
        for name in names:
            self.wait_until(lambda n=name: self._started(n, before[n]) or not self.runs(n), what=f"{name} to start")
            assert self.runs(name), self.output(name)

    def _started(self, name: str, before: int) -> bool:
        return self.output(name).count("takes jobs") > before

    def output(self, name: str) -> str:
        file = self.folder / f"{name}.out"
        return file.read_text() if file.exists() else ""

    def runs(self, name: str) -> bool:
        return self.processes[name].poll() is None

    def kill(self, name: str) -> None:
        """Kill with SIGKILL and clear the output."""
        process = self.processes.pop(name)
        process.send_signal(signal.SIGCONT)
        process.kill()
        process.wait()
        (self.folder / f"{name}.out").write_text("")

    def signal(self, name: str, number: signal.Signals) -> None:
        self.processes[name].send_signal(number)

    def job(self, identity: str) -> dict[str, Any]:
        row = self.reader.rows([identity]).get(identity)
        return {"state": row.state, "result": row.result, "failure": row.failure} if row else {"state": "none"}

    def wait_for_end(self, *identities: str, within_s: float = 300.0) -> None:
        """Wait until these jobs have ended."""
        final = ("done", "failed", "cancelled")
        self.wait_until(
            lambda: all(self.job(i)["state"] in final for i in identities), within_s, what=f"{identities} to end"
        )

    def wait_until(self, condition: Callable[[], bool], within_s: float = 300.0, what: str = "it") -> float:
        start = time.monotonic()
        while not condition():
            if time.monotonic() - start > within_s:
                outputs = "\n".join(f"--- {n}\n{self.output(n)[-3000:]}" for n in self.processes)
                raise AssertionError(f"waited {within_s} s for {what}\n{queue_metrics(self.reader)}\n{outputs}")
            time.sleep(0.05)
        return time.monotonic() - start

    def lines(self, begin: str = "") -> Counter[str]:
        """Count the lines of the trace that begin with `begin`, without process ids."""
        text = self.trace.read_text() if self.trace.exists() else ""
        return Counter(line.rpartition(" ")[0] for line in text.splitlines() if line.startswith(begin))

    def close(self) -> None:
        self.queue.close()
        for process in self.processes.values():
            process.send_signal(signal.SIGCONT)
            process.kill()
            process.wait()


@contextmanager
def open_farm(
    folder: Path, url: str | None = None, timeouts: dict[str, float] | None = None, work: dict[str, str] = LIGHT
) -> Iterator[Farm]:
    farm = Farm(folder, url or f"sqlite:///{folder / 'queue.sqlite'}", timeouts, work)
    try:
        yield farm
    finally:
        farm.close()


def alive(pid: int) -> bool:
    """Return whether the process runs and is not a zombie."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


def children_of(pid: int) -> list[int]:
    """Return the process ids of the direct children."""
    pids = []
    for task in Path(f"/proc/{pid}/task").iterdir():
        pids += [int(child) for child in (task / "children").read_text().split()]
    return pids
