"""Cost of the queue itself with 20,000 jobs without work: submission, polling, coordination and storage.

    python -m bench.farm_queue [--captures 20000] [--db URL] [--seconds 60] [--settle 15]

Workers run only for some seconds: with one job at a time they are limited by polling, four times a second.
"""

import argparse
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import sqlalchemy as sa

from bench.support.postgres_server import server
from workflows.engine.client import QueueClient
from workflows.engine.database import checked_url, default_url, engine, is_sqlite, sqlite_file
from workflows.engine.jobs import DRIVER, FlowJob, Job
from workflows.engine.metrics import queue_metrics
from workflows.engine.process import migrate
from workflows.engine.reader import QueueReader, ended

MB = 2**20


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--captures", type=int, default=20_000)
    parser.add_argument("--db", default="sqlite", help="sqlite, postgres (a server is started), or a URL")
    parser.add_argument("--seconds", type=float, default=60.0, help="run time of two workers, s")
    parser.add_argument("--settle", type=float, default=15.0, help="delay before the coordinator's memory is read, s")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="gnmreg-queue-") as name:
        if options.db == "postgres":
            with server() as running:
                _measure(running.url, Path(name), options)
        else:
            url = default_url(Path(name)) if options.db == "sqlite" else options.db
            _measure(url, Path(name), options)


def _measure(url: str, folder: Path, options: argparse.Namespace) -> None:
    captures: int = options.captures
    migrate(url)
    empty = _size_mb(url)
    queue, reader = QueueClient(url), QueueReader(url)
    arguments = {"capture": "/data/captures/subject_0000/expression_00", "model": "/data/model.npz", "seed": 0}
    jobs = (Job(id=f"bench/s{n:05d}", step="nothing", arguments={**arguments, "key": n}) for n in range(captures))
    start = time.perf_counter()
    queue.submit(jobs)
    seconds = time.perf_counter() - start
    queue.submit([FlowJob(id="bench", flow="batch", queue=DRIVER)])
    _row("enqueue", f"{captures / seconds:.0f} jobs/s ({captures:,} in {seconds:.1f} s)")
    full = _size_mb(url)
    _row("database", f"{(full - empty) * 10_000 / captures:.1f} MB per 10,000 jobs that wait")
    _row("status, all waiting", f"{_status_seconds(reader):.3f} s; as a command {_command_seconds(url, folder):.2f} s")
    processes = {kind: _start(kind, url, folder, kind) for kind in ("coordinator",)}
    time.sleep(options.settle)
    _row("coordinator", f"{_rss_mb(processes['coordinator'].pid):.0f} MB while {captures:,} jobs wait")
    for number in (0, 1):
        processes[f"worker{number}"] = _start("worker", url, folder, f"worker{number}")
    while not ended(reader.counts("bench")):
        time.sleep(0.2)
    first, start = ended(reader.counts("bench")), time.perf_counter()
    time.sleep(options.seconds)
    done = ended(reader.counts("bench"))
    seconds = time.perf_counter() - start
    _row(
        "complete, 2 workers", f"{(done - first) / seconds:.1f} jobs/s, {(done - first) / seconds * 86_400:,.0f} a day"
    )
    _row("status, at work", f"{_status_seconds(reader):.3f} s")
    grown = (_size_mb(url) - full) * 10_000 / max(done, 1)
    _row("database", f"{(full - empty) * 10_000 / captures + grown:.1f} MB per 10,000 jobs that are done")
    _row("memory", ", ".join(f"{name} {_rss_mb(process.pid):.0f} MB" for name, process in processes.items()))
    for process in processes.values():
        process.kill()
        process.wait()
    queue.close()


def _start(kind: str, url: str, folder: Path, name: str) -> "subprocess.Popen[bytes]":
    command = [sys.executable, "-m", "bench.support.farm_queue_process", kind, url, str(folder), name]
    return subprocess.Popen(command, cwd=Path(__file__).parents[1], stdout=subprocess.DEVNULL)


def _status_seconds(reader: QueueReader) -> float:
    start = time.perf_counter()
    queue_metrics(reader, "bench")
    return time.perf_counter() - start


def _command_seconds(url: str, folder: Path) -> float:
    start = time.perf_counter()
    command = [sys.executable, "-m", "workflows.cli", "status", "--folder", str(folder)]
    environment = {**os.environ, "GNMREG_DB": url}
    subprocess.run(command, cwd=Path(__file__).parents[1], env=environment, check=True, stdout=subprocess.DEVNULL)
    return time.perf_counter() - start


def _size_mb(url: str) -> float:
    if is_sqlite(url):
        file = sqlite_file(checked_url(url))
        with engine(url).connect() as connection:
            connection.exec_driver_sql("PRAGMA wal_checkpoint(TRUNCATE)")  # otherwise the log would be counted, too
        return sum(path.stat().st_size for path in file.parent.glob(f"{file.name}*") if path.is_file()) / MB
    with engine(checked_url(url)).connect() as connection:
        return float(connection.execute(sa.text("SELECT pg_database_size(current_database())")).scalar_one()) / MB


def _rss_mb(pid: int) -> float:
    fields: dict[str, Any] = dict(line.split(":", 1) for line in Path(f"/proc/{pid}/status").read_text().splitlines())
    return int(fields["VmHWM"].split()[0]) / 1024


def _row(what: str, value: str) -> None:
    print(f"{what:22s} {value}", flush=True)


if __name__ == "__main__":
    main()
