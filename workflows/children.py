"""Calls in processes beside this one: warm, ended with their parent, and none the worse for the others if one dies."""

import ctypes
import os
import signal
import sys
import traceback
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from multiprocessing import get_context
from multiprocessing.connection import Connection, wait
from multiprocessing.context import SpawnProcess
from typing import Any

from registration.errors import InputError
from registration.progress import Named, Progress, Silent


@dataclass(frozen=True, kw_only=True)
class Lost:
    """A call that gave no result."""

    reason: str


def in_children(
    function: Callable[..., Any],
    calls: Mapping[str, Mapping[str, Any]],
    *,
    jobs: int = 1,
    tries: int = 2,
    progress: Progress | None = None,
) -> Iterator[tuple[str, Any]]:
    """Call a function once for each of some named sets of keywords, in `jobs` processes; yields results as they come.

    Yields (name, what was returned, or `Lost`). An exception is a lost call; one whose process dies, as a crash in a
    library makes it, is tried again in a fresh one, `tries` times in all. The function must be importable and take
    `progress`; what it notes is told with the call's name. The machine's cores are split among the jobs.
    """
    progress, waiting = progress or Silent(), deque((name, 1) for name in calls)
    children: list[_Child] = []
    try:
        while waiting or children:
            while waiting and len(children) < jobs:
                children.append(_Child(jobs))
                children[-1].give(function, *waiting.popleft(), calls)
            for child in [c for c in children if c.pipe in wait([c.pipe for c in children])]:
                name, tried = child.name, child.tried
                try:
                    kind, what = child.pipe.recv()
                except (EOFError, ConnectionError):
                    children.remove(child)
                    reason = child.ended()
                    progress.note(f"{name}: {reason}" + ("; once more" if tried < tries else ""))
                    if tried < tries:
                        waiting.appendleft((name, tried + 1))
                    else:
                        yield name, Lost(reason=reason)
                    continue
                if kind in ("note", "at"):
                    getattr(Named(progress, name), kind)(*what)
                    continue
                if waiting:
                    child.give(function, *waiting.popleft(), calls)
                else:
                    children.remove(child)
                    child.end()
                yield name, Lost(reason=what) if kind == "lost" else what
    finally:
        for child in children:
            child.kill()


class _Child:
    """One process and the call it is busy with."""

    def __init__(self, jobs: int) -> None:
        spawn = get_context("spawn")  # a fork would share the threads of torch and Dr.Jit
        self.pipe, other = spawn.Pipe()
        self.name, self.tried = "", 0
        with _fewer_threads(jobs):
            self._process: SpawnProcess = spawn.Process(target=_serve, args=(other, os.getpid()), daemon=True)
            self._process.start()
        other.close()

    def give(self, function: Callable[..., Any], name: str, tried: int, calls: Mapping[str, Mapping[str, Any]]) -> None:
        self.name, self.tried = name, tried
        with suppress(OSError):  # it died just now: reading from it will tell
            self.pipe.send((function, dict(calls[name])))

    def ended(self) -> str:
        """Why it died."""
        self._process.join()
        code = self._process.exitcode or 0
        how = signal.Signals(-code).name if code < 0 else f"exit code {code}"
        return f"the process ended by itself, {how}"

    def end(self) -> None:
        self.pipe.send(None)
        self._process.join()
        self.pipe.close()

    def kill(self) -> None:
        self._process.kill()
        self._process.join()
        self.pipe.close()


class _Sent:
    """A progress that tells the parent."""

    def __init__(self, pipe: Connection) -> None:
        self._pipe = pipe

    def note(self, text: str) -> None:
        self._pipe.send(("note", (text,)))

    def at(self, done: int, total: int, what: str) -> None:
        self._pipe.send(("at", (done, total, what)))


def _serve(pipe: Connection, parent: int) -> None:
    """A child's life: calls in, results out, until None comes."""
    _end_with(parent)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches the whole group; the parent decides
    while (given := pipe.recv()) is not None:
        function, arguments = given
        try:
            pipe.send(("done", function(**arguments, progress=_Sent(pipe))))
        except InputError as error:
            pipe.send(("lost", error.line))
        except Exception as error:
            _Sent(pipe).note(traceback.format_exc())
            pipe.send(("lost", f"{type(error).__name__}: {next(iter(str(error).splitlines()), '')}"))


def _end_with(parent: int) -> None:
    """Ask Linux to end this process when its parent ends, however that ends."""
    if sys.platform == "linux":
        death_signal = 1  # PR_SET_PDEATHSIG
        ctypes.CDLL(None).prctl(death_signal, signal.SIGKILL)
    if os.getppid() != parent:  # it ended before
        os._exit(1)


@contextmanager
def _fewer_threads(jobs: int) -> Iterator[None]:
    """A child's share of the cores, which libraries read from the environment as they are loaded."""
    name = "OMP_NUM_THREADS"
    former = os.environ.get(name)
    if jobs > 1 and former is None:
        os.environ[name] = str(max(1, (os.cpu_count() or 1) // jobs))
    try:
        yield
    finally:
        if former is None:
            os.environ.pop(name, None)
