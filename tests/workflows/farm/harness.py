"""Farms for tests: processes that are started, killed and frozen, and the queue that they share."""

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
from workflows.engine.process import migrate
from workflows.engine.reader import QueueReader

QUICK = {"poll_s": 0.3, "release_s": 1.0, "uptime_s": 0.0}


def interruptible() -> None:
    """In a child, before it starts: a shell makes what it runs in the background, tests too, deaf to Ctrl-C."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)


class Farm:
    """A queue and its processes, named by their executor ids."""

    def __init__(self, folder: Path, url: str, timeouts: dict[str, float] | None = None) -> None:
        self.folder, self.url = folder, url
        self.settings = {"timeouts": timeouts or QUICK}
        self.processes: dict[str, subprocess.Popen[bytes]] = {}
        self.trace = folder / "trace.txt"
        migrate(url)
        self.queue, self.reader = QueueClient(url), QueueReader(url)

    def start(self, *names: str) -> None:
        """Names that begin with "c" are coordinators. Returns when all of them take jobs."""
        before = {name: self.said(name).count("takes jobs") for name in names}
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
            self.until(lambda n=name: self._started(n, before[n]) or not self.runs(n), what=f"{name} to start")
            assert self.runs(name), self.said(name)

    def _started(self, name: str, before: int) -> bool:
        return self.said(name).count("takes jobs") > before

    def said(self, name: str) -> str:
        file = self.folder / f"{name}.out"
        return file.read_text() if file.exists() else ""

    def runs(self, name: str) -> bool:
        return self.processes[name].poll() is None

    def kill(self, name: str) -> None:
        """kill -9, and forget what it said."""
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

    def ends(self, *identities: str, within_s: float = 300.0) -> None:
        """Wait until these jobs have ended."""
        over = ("done", "failed", "cancelled")
        self.until(lambda: all(self.job(i)["state"] in over for i in identities), within_s, what=f"{identities} to end")

    def until(self, condition: Callable[[], bool], within_s: float = 300.0, what: str = "it") -> float:
        begun = time.monotonic()
        while not condition():
            if time.monotonic() - begun > within_s:
                said = "\n".join(f"--- {n}\n{self.said(n)[-3000:]}" for n in self.processes)
                raise AssertionError(f"waited {within_s} s for {what}\n{self.reader.metrics()}\n{said}")
            time.sleep(0.05)
        return time.monotonic() - begun

    def lines(self, begin: str = "") -> Counter[str]:
        """What the steps traced, without process ids."""
        text = self.trace.read_text() if self.trace.exists() else ""
        return Counter(line.rpartition(" ")[0] for line in text.splitlines() if line.startswith(begin))

    def close(self) -> None:
        self.queue.close()
        for process in self.processes.values():
            process.send_signal(signal.SIGCONT)
            process.kill()
            process.wait()


@contextmanager
def farm(folder: Path, url: str | None = None, timeouts: dict[str, float] | None = None) -> Iterator[Farm]:
    made = Farm(folder, url or f"sqlite:///{folder / 'queue.sqlite'}", timeouts)
    try:
        yield made
    finally:
        made.close()


def alive(pid: int) -> bool:
    """Whether a process runs that is no zombie."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


def children_of(pid: int) -> list[int]:
    """Process ids of the direct children."""
    found = []
    for task in Path(f"/proc/{pid}/task").iterdir():
        found += [int(child) for child in (task / "children").read_text().split()]
    return found
