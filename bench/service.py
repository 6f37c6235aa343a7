"""The service with 20,000 captures in its queue: time of its pages, memory, and many viewers that follow it.

    python -m bench.service [--captures 20000] [--requests 50] [--viewers 50] [--seconds 60] [--changes 20] [--db URL]

The queue's rows pretend what workers did. While the viewers follow, some captures change every second; what each viewer
received is compared with the database at the end.
"""

import argparse
import http.client
import json
import random
import re
import select
import socket
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

from bench.support import pretended_queue
from workflows.engine.database import default_url
from workflows.engine.process import migrate
from workflows.engine.reader import QueueReader
from workflows.service.settings import ServiceSettings
from workflows.service.tokens import Tokens

RUN = "monday"
SETTLE_S = 5.0  # after the last change, until a viewer must know it
_EVENT = re.compile(r"^event: (\w+)\ndata: (.*)$", re.MULTILINE)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--captures", type=int, default=20_000)
    parser.add_argument("--requests", type=int, default=50, help="of each page")
    parser.add_argument("--viewers", type=int, default=50)
    parser.add_argument("--seconds", type=float, default=60.0, help="for which the viewers follow, s")
    parser.add_argument("--changes", type=int, default=20, help="captures that change each second")
    parser.add_argument("--db", help="URL of an empty database; a SQLite file unless given")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="gnmreg-service-") as name:
        folder = Path(name)
        url = options.db or default_url(folder)
        migrate(url)
        begin_s = time.perf_counter()
        ids = pretended_queue.fill(url, folder / "results" / RUN, RUN, options.captures)
        registered = ids[: round(pretended_queue.Shares().done * options.captures)]
        pretended_queue.write_manifests(folder / "results" / RUN, [job.partition("/")[2] for job in registered])
        _row("queue", f"{len(ids):,} captures, written in {time.perf_counter() - begin_s:.0f} s")
        token = Tokens(ServiceSettings(url=url, folder=folder).state).create("bench", ["operator"])
        begin_s = time.perf_counter()
        process, port = start(url, folder)
        try:
            _row("start", f"{time.perf_counter() - begin_s:.1f} s")
            _measure(Target(port=port, token=token, url=url, pid=process.pid), ids, options)
        finally:
            process.terminate()
            process.wait(30.0)


@dataclass(frozen=True, kw_only=True)
class Target:
    """A service that runs."""

    port: int
    token: str
    url: str  # of the queue
    pid: int

    def get(self, path: str) -> tuple[float, bytes]:
        """Return the seconds until an answer is read, and the answer."""
        start = time.perf_counter()
        connection = http.client.HTTPConnection("127.0.0.1", self.port, timeout=60)
        headers = {"Authorization": f"Bearer {self.token}", "Accept": "text/html"}
        connection.request("GET", path, headers=headers)
        response = connection.getresponse()
        body = response.read()
        connection.close()
        if response.status != 200:
            raise RuntimeError(f"{path}: {response.status} {body[:300]!r}")
        return time.perf_counter() - start, body

    def memory_mb(self) -> tuple[float, float]:
        """Return the memory now and at most, MB."""
        lines = Path(f"/proc/{self.pid}/status").read_text().splitlines()
        fields = dict(line.split(":", 1) for line in lines)
        return int(fields["VmRSS"].split()[0]) / 1024, int(fields["VmHWM"].split()[0]) / 1024


def _measure(target: Target, ids: Sequence[str], options: argparse.Namespace) -> None:
    _open_gate(target)
    pages = {
        "overview": "/",
        "run page": f"/runs/{RUN}",
        "run page, filtered": f"/runs/{RUN}?status=look&text=subject_0",
        "run page, last": f"/runs/{RUN}?number=100000",
        "capture page": f"/captures/{ids[0]}",
        "run at the gate": f"/gate/{RUN}",
        "job list of the API": f"/api/v1/jobs?run={RUN}&limit=100",
    }
    for title, path in pages.items():
        size = len(target.get(path)[1])
        seconds = [target.get(path)[0] for _ in range(options.requests)]
        worst = sorted(seconds)[int(0.95 * (len(seconds) - 1))]
        _row(
            title,
            f"{1000 * statistics.median(seconds):.0f} ms median, {1000 * worst:.0f} ms 95 %, {size / 1024:.0f} kB",
        )
    _row("memory", "{:.0f} MB, at most {:.0f} MB".format(*target.memory_mb()))
    if options.viewers:
        _follow(target, ids, options)
        _row("memory after that", "{:.0f} MB, at most {:.0f} MB".format(*target.memory_mb()))


def _open_gate(target: Target) -> None:
    """Ask for the run at the gate until the service has read all manifests."""
    begin_s, seconds, body = time.monotonic(), list[float](), b"not read yet"
    while b"not read yet" in body:
        took_s, body = target.get(f"/gate/{RUN}")
        seconds.append(took_s)
        time.sleep(0.3)
    _row(
        "gate, at first",
        f"{1000 * statistics.median(seconds):.0f} ms median, {1000 * max(seconds):.0f} ms at most, "
        f"while manifests are read for {time.monotonic() - begin_s:.0f} s",
    )


@dataclass
class Viewer:
    """A stream of events, as a browser reads it."""

    connection: socket.socket
    text: str = ""
    seen: dict[str, str] = field(default_factory=dict)  # job -> its last state
    events: int = 0
    resets: int = 0

    def read(self) -> None:
        """Take what has arrived."""
        part = self.connection.recv(1 << 16)
        if not part:
            raise RuntimeError("the service ended a stream of events")
        self.text += part.decode()
        *whole, self.text = self.text.split("\n\n")
        for event in whole:
            if match := _EVENT.search(event):
                kind, data = match.groups()
                self.events += 1
                self.resets += kind == "reset"
                if kind == "job":
                    job = json.loads(data)
                    self.seen[job["id"]] = job["state"]


def _follow(target: Target, ids: Sequence[str], options: argparse.Namespace) -> None:
    """Let viewers follow while captures change, then compare what they saw with the database."""
    viewers = [_viewer(target) for _ in range(options.viewers)]
    chance, changed, pages_s = random.Random(1), set[str](), list[float]()
    start, next_s = time.monotonic(), 0.0
    while time.monotonic() < start + options.seconds:
        if time.monotonic() > start + next_s:
            next_s += 1.0
            chosen = chance.sample(ids, min(options.changes, len(ids)))
            pretended_queue.write(target.url, [_change(identity, chance) for identity in chosen])
            changed |= set(chosen)
            pages_s.append(target.get("/")[0])
        _take(viewers, 0.2)
    until = time.monotonic() + SETTLE_S
    while time.monotonic() < until:
        _take(viewers, 0.2)
    rows = {row.id: row.state for row in QueueReader(target.url).times(RUN) if row.id in changed}
    lost = sum(viewer.seen.get(identity) != state for viewer in viewers for identity, state in rows.items())
    events = [viewer.events for viewer in viewers]
    _row(
        f"{len(viewers)} viewers",
        f"{lost} lost of {len(rows) * len(viewers):,} states, {sum(viewer.resets for viewer in viewers)} resets; "
        f"{min(events)} to {max(events)} events each in {options.seconds:.0f} s",
    )
    _row("overview meanwhile", f"{1000 * statistics.median(pages_s):.0f} ms median")
    for viewer in viewers:
        viewer.connection.close()


def _viewer(target: Target) -> Viewer:
    connection = socket.create_connection(("127.0.0.1", target.port), timeout=30)
    lines = ("GET /api/v1/events HTTP/1.1", f"Host: 127.0.0.1:{target.port}", f"Authorization: Bearer {target.token}")
    connection.sendall("\r\n".join((*lines, "", "")).encode())
    viewer = Viewer(connection)
    while "retry:" not in viewer.text:
        viewer.text += connection.recv(1 << 16).decode()
    viewer.text = ""
    return viewer


def _take(viewers: Sequence[Viewer], seconds: float) -> None:
    ready, _, _ = select.select([viewer.connection for viewer in viewers], [], [], seconds)
    arrived = set(ready)
    for viewer in viewers:
        if viewer.connection in arrived:
            viewer.read()


def _change(identity: str, chance: random.Random) -> dict[str, object]:
    now = time.time()
    times = {"started_at_epoch_ms": 1000 * (now - 30), "completed_at": 1000 * now, "executor_id": "lab-gpu0"}
    if chance.random() < 0.3:
        return {
            **{"id": identity, "status": "ENQUEUED", "executor_id": None, "output": None, "error": None},
            **{"started_at_epoch_ms": None, "completed_at": None},
        }
    return {"id": identity, "status": "SUCCESS", **times, "output": pretended_queue.result_text(chance), "error": None}


def start(url: str, folder: Path) -> tuple["subprocess.Popen[str]", int]:
    """Start `gnmreg serve`; return it and its port."""
    command = [sys.executable, "-m", "workflows.cli", "serve", "--folder", str(folder), "--db", url, "--port", "0"]
    log = (folder / "serve.log").open("w")
    process = subprocess.Popen(command, cwd=Path(__file__).parents[1], stdout=subprocess.PIPE, stderr=log, text=True)
    assert process.stdout is not None
    for line in process.stdout:
        if match := re.search(r"Open http://[^:]+:(\d+)", line):
            return process, int(match[1])
    raise RuntimeError(f"the service did not start: {(folder / 'serve.log').read_text()[-2000:]}")


def _row(what: str, value: str) -> None:
    print(f"{what:22s} {value}", flush=True)


if __name__ == "__main__":
    main()
