"""A farm on one machine: a coordinator and workers as child processes of this command, which terminates them."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

from registration.errors import InputError
from registration.progress import Progress
from workflows.engine.database import ENVIRONMENT
from workflows.engine.presence import living_processes, uncovered
from workflows.engine.reader import CANCELLED, DONE, FAILED, RUNNING, WAITING, QueueReader, ended
from workflows.processes import cores_per_worker, terminate_with_parent

POLL_S = 1.0
STUCK_S = 10.0  # after which jobs that nobody takes end a command
RETRY_S = 2.0  # before a process that died is restarted
REFUSED = 2  # exit code of a command with unusable arguments


@dataclass(frozen=True, kw_only=True)
class LocalFarm:
    """The processes to start."""

    url: str
    folder: Path  # of the logs
    roots: tuple[str, ...]  # folders and URLs that jobs may use
    workers: int = 1
    gpus: tuple[int, ...] = ()  # one worker each, instead of `workers`
    environment: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True, kw_only=True)
class LocalRunResult:
    """How a run ended."""

    counts: Mapping[str, int]  # state -> jobs
    reason: str = ""  # of the driver's failure


def run_until_done(
    farm: LocalFarm,
    run: str,
    progress: Progress,
    on_counts: Callable[[Mapping[str, int]], None] = lambda counts: None,
) -> LocalRunResult:
    """Start the farm, wait until a run's driver has ended, stop the farm.

    The processes end with this function, also on Ctrl-C and kill -9; the next call continues the run.

    Args:
        farm: the processes.
        run: name of the run.
        progress: where to report to.
        on_counts: called every second with the numbers of jobs by state.

    Raises:
        InputError: no workers, or a process could not start.
    """
    if not farm.gpus and farm.workers < 1:
        raise InputError(
            "There are no workers", where="--workers", expected="at least 1", got=farm.workers, fix="use one or more"
        )
    processes = FarmProcesses(farm)
    reader = QueueReader(farm.url)
    stuck_s = 0.0  # for which all jobs that are left lie outside the roots
    try:
        while True:
            processes.restart()
            row = reader.rows([run]).get(run)
            counts = reader.counts(run, kind="job")
            progress.update(ended(counts), max(sum(counts.values()), 1), _summary(counts))
            on_counts(counts)
            if row is not None and row.state in (DONE, FAILED, CANCELLED):
                reason = f"{row.failure['status']}: {row.failure['reason']}" if row.failure else ""
                return LocalRunResult(counts=counts, reason=reason)
            stuck_s = stuck_s + POLL_S if _nobody_takes(reader, run, counts) else 0.0
            if stuck_s > STUCK_S:
                reason = f"{counts[WAITING]} jobs of an earlier command wait: they lie outside the folders of this one"
                return LocalRunResult(counts=counts, reason=f"{reason}; name all captures, or `gnmreg cancel {run}`")
            time.sleep(POLL_S)
    finally:
        processes.terminate()


def _nobody_takes(reader: QueueReader, run: str, counts: Mapping[str, int]) -> bool:
    """Whether nothing runs, and every job that waits lies outside the roots of all workers."""
    if counts.get(RUNNING) or not counts.get(WAITING):
        return False
    waiting = {row.id: row.queue for row in reader.times(run) if row.kind == "job" and row.state == WAITING}
    return 0 < len(waiting) == len(uncovered(living_processes(reader.url), waiting))


def _summary(counts: Mapping[str, int]) -> str:
    return ", ".join(f"{counts[state]} {state}" for state in (RUNNING, WAITING, DONE, FAILED) if counts.get(state))


class FarmProcesses:
    """Commands that are restarted when they die."""

    def __init__(self, farm: LocalFarm) -> None:
        """Nothing is started before `restart`."""
        devices = [["--gpu", str(number)] for number in farm.gpus] or [[] for _ in range(farm.workers)]
        shared = ["--folder", str(farm.folder), "--db", ENVIRONMENT]  # the URL may hold a password
        roots = ["--root", *farm.roots] if farm.roots else []
        queues = ["--queue", "gpu", "rebuild"]
        workers = [["worker", *shared, *roots, *queues, *device] for device in devices]
        self._commands = [["coordinator", *shared], *workers]
        self._farm = farm
        self._processes: list[subprocess.Popen[bytes] | None] = [None] * len(self._commands)
        self._started_s = [0.0] * len(self._commands)

    def restart(self) -> None:
        """Start the commands that do not run. Raises InputError if one of them cannot start."""
        for number, process in enumerate(self._processes):
            code = process.poll() if process is not None else 0
            if process is not None and code is None:
                continue
            if code == REFUSED:
                raise InputError(
                    "A process of the farm could not start",
                    where=" ".join(self._commands[number]),
                    expected="a process that takes jobs",
                    got=f"exit code {code}",
                    fix="see its output above",
                )
            if time.monotonic() - self._started_s[number] > RETRY_S:
                self._started_s[number] = time.monotonic()
                self._processes[number] = self._start(number)

    def terminate(self) -> None:
        """Send SIGTERM to all, then SIGKILL to those that still run."""
        running = [process for process in self._processes if process is not None and process.poll() is None]
        for process in running:
            process.terminate()
        deadline = time.monotonic() + 15.0
        for process in running:
            with suppress(subprocess.TimeoutExpired):
                process.wait(max(0.1, deadline - time.monotonic()))
            process.kill()
            process.wait()

    def _start(self, number: int) -> subprocess.Popen[bytes]:
        parent = os.getpid()
        environment = {**os.environ, **self._farm.environment, ENVIRONMENT: self._farm.url}
        environment.setdefault("OMP_NUM_THREADS", cores_per_worker(len(self._commands) - 1))
        return subprocess.Popen(
            [sys.executable, "-m", "workflows.cli", *self._commands[number]],
            env=environment,
            stdin=subprocess.DEVNULL,
            stdout=sys.stderr.fileno(),
            start_new_session=True,  # only this process receives Ctrl-C
            preexec_fn=lambda: terminate_with_parent(parent, signal.SIGTERM),
        )


def local_gpus() -> tuple[int, ...]:
    """Return the numbers of the GPUs that the driver lists."""
    try:
        listed = subprocess.run(["nvidia-smi", "-L"], capture_output=True, text=True, check=True, timeout=30).stdout
    except (OSError, subprocess.SubprocessError):
        return ()
    return tuple(range(sum(line.startswith("GPU ") for line in listed.splitlines())))
