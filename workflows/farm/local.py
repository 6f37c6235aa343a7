"""A farm on one machine: a coordinator and workers as processes of this command, which ends them."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

from registration.errors import InputError
from registration.progress import Progress
from workflows.engine.database import ENVIRONMENT
from workflows.engine.reader import CANCELLED, DONE, FAILED, RUNNING, WAITING, QueueReader, ended
from workflows.processes import cores_per_worker, terminate_with_parent

POLL_S = 1.0
RETRY_S = 2.0  # after which a process that died is started again
REFUSED = 2  # the exit code of a command that was given something unusable


@dataclass(frozen=True, kw_only=True)
class LocalFarm:
    """What is to be started."""

    url: str
    folder: Path  # its logs go below
    roots: tuple[str, ...]
    workers: int = 1
    gpus: tuple[int, ...] = ()  # one worker each, instead of `workers`
    environment: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True, kw_only=True)
class Ended:
    """What became of a run."""

    counts: Mapping[str, int]  # state -> jobs
    reason: str = ""  # why its driver failed, if it did


def run_until_done(farm: LocalFarm, run: str, progress: Progress) -> Ended:
    """Start the farm, wait until a run's driver has ended, end the farm.

    Whatever ends this function, Ctrl-C and kill -9 among it, ends the processes. What is left is done by the next call.

    Raises:
        InputError: there is to be no worker, or a process refused to start.
    """
    if not farm.gpus and farm.workers < 1:
        raise InputError(
            "There is no worker", where="--workers", expected="from 1", got=farm.workers, fix="ask for one or more"
        )
    processes = _Processes(farm)
    reader = QueueReader(farm.url)
    try:
        while True:
            processes.look()
            row = reader.rows([run]).get(run)
            counts = reader.counts(run, kind="job")
            progress.at(ended(counts), max(sum(counts.values()), 1), _told(counts))
            if row is not None and row.state in (DONE, FAILED, CANCELLED):
                failure = row.failure
                return Ended(counts=counts, reason=f"{failure['status']}: {failure['reason']}" if failure else "")
            time.sleep(POLL_S)
    finally:
        processes.end()


def _told(counts: Mapping[str, int]) -> str:
    return ", ".join(f"{counts[state]} {state}" for state in (RUNNING, WAITING, DONE, FAILED) if counts.get(state))


class _Processes:
    """Commands that are started again when they die."""

    def __init__(self, farm: LocalFarm) -> None:
        places = [["--gpu", str(number)] for number in farm.gpus] or [[] for _ in range(farm.workers)]
        shared = ["--folder", str(farm.folder)]
        roots = ["--root", *farm.roots] if farm.roots else []
        queues = ["--queue", "gpu", "rebuild"]
        self._commands = [["coordinator", *shared], *(["worker", *shared, *roots, *queues, *p] for p in places)]
        self._farm = farm
        self._processes: list[subprocess.Popen[bytes] | None] = [None] * len(self._commands)
        self._since = [0.0] * len(self._commands)

    def look(self) -> None:
        """Start what does not run. Raises InputError for one that refuses."""
        for number, process in enumerate(self._processes):
            code = process.poll() if process is not None else 0
            if process is not None and code is None:
                continue
            if code == REFUSED:
                raise InputError(
                    "A process of the farm could not start",
                    where=" ".join(self._commands[number]),
                    expected="a worker that takes jobs",
                    got=f"exit code {code}",
                    fix="see what it printed above",
                )
            if time.monotonic() - self._since[number] > RETRY_S:
                self._since[number] = time.monotonic()
                self._processes[number] = self._started(number)

    def end(self) -> None:
        """SIGTERM to all, SIGKILL to those that stay."""
        running = [process for process in self._processes if process is not None and process.poll() is None]
        for process in running:
            process.terminate()
        deadline = time.monotonic() + 15.0
        for process in running:
            with suppress(subprocess.TimeoutExpired):
                process.wait(max(0.1, deadline - time.monotonic()))
            process.kill()
            process.wait()

    def _started(self, number: int) -> subprocess.Popen[bytes]:
        parent = os.getpid()
        environment = {**os.environ, **self._farm.environment, ENVIRONMENT: self._farm.url}
        environment.setdefault("OMP_NUM_THREADS", cores_per_worker(len(self._commands) - 1))
        return subprocess.Popen(
            [sys.executable, "-m", "workflows.cli", *self._commands[number]],
            env=environment,
            stdin=subprocess.DEVNULL,
            stdout=sys.stderr.fileno(),
            start_new_session=True,  # Ctrl-C is for us; we end them
            preexec_fn=lambda: terminate_with_parent(parent, signal.SIGTERM),
        )


def gpus_here(asked: Sequence[int] | None) -> tuple[int, ...]:
    """The GPUs to use: those asked for, or all that the driver names."""
    if asked:
        return tuple(asked)
    try:
        listed = subprocess.run(["nvidia-smi", "-L"], capture_output=True, text=True, check=True, timeout=30).stdout
    except (OSError, subprocess.SubprocessError):
        return ()
    return tuple(range(sum(line.startswith("GPU ") for line in listed.splitlines())))
