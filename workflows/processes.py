"""Child processes that terminate with their parent, however that ends, and share the machine's cores."""

import ctypes
import importlib
import os
import signal
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Future, as_completed
from contextlib import contextmanager
from multiprocessing.context import SpawnContext, SpawnProcess
from typing import Any

from pebble import ProcessExpired, ProcessPool

_PR_SET_PDEATHSIG = 1
_THREADS = "OMP_NUM_THREADS"  # libraries and the renderer read it when they are loaded


def terminate_with_parent(parent: int, number: signal.Signals = signal.SIGKILL) -> None:
    """Ask Linux, in a child before anything else, to send it a signal when the parent ends.

    The kernel watches the *thread* that started the child: start it from one that lives as long as the process.

    Args:
        parent: process id of the parent.
        number: the signal.
    """
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, number)
    if os.getppid() != parent:  # the parent ended before the call above
        os._exit(1)


class _Child(SpawnProcess):
    """A process that never receives Ctrl-C, which a terminal sends to children too: the parent decides."""

    def start(self) -> None:
        before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})  # children inherit it, from their first line
        try:
            super().start()
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)


class _Context(SpawnContext):
    """Starts new interpreters: a fork would share the threads of torch and Dr.Jit."""

    Process = _Child


def start_pool(jobs: int = 1, modules: tuple[str, ...] = ()) -> ProcessPool:
    """Return a pool of processes that terminate with this one and import `modules` when they start."""
    return ProcessPool(
        max_workers=jobs,
        max_tasks=0,
        initializer=_initialize_child,
        initargs=(os.getpid(), modules),
        context=_Context(),
    )


def _initialize_child(parent: int, modules: tuple[str, ...]) -> None:
    terminate_with_parent(parent)
    for module in modules:
        importlib.import_module(module)
    # Restore the default handler, which libraries may replace: terminate even while the interpreter's lock is held.
    signal.signal(signal.SIGTERM, signal.SIG_DFL)


@contextmanager
def terminated_with_us(jobs: int, modules: tuple[str, ...] = ()) -> Iterator[ProcessPool]:
    """A pool as of `start_pool`, whose processes are killed at the end of the context."""
    pool = start_pool(jobs, modules)
    try:
        yield pool
    finally:
        pool.stop()
        pool.join()


def cores_per_worker(jobs: int) -> str:
    """Return the value of OMP_NUM_THREADS that divides the cores among `jobs` processes."""
    return str(max(1, (os.cpu_count() or 1) // max(1, jobs)))


@contextmanager
def shared_cores(jobs: int) -> Iterator[None]:
    """Divide the cores among processes started in this context, unless the environment sets OMP_NUM_THREADS."""
    if jobs < 2 or _THREADS in os.environ:
        yield
        return
    os.environ[_THREADS] = cores_per_worker(jobs)
    try:
        yield
    finally:
        del os.environ[_THREADS]


def run_parallel(
    function: Callable[..., str], calls: Mapping[str, Mapping[str, Any]], jobs: int
) -> Iterator[tuple[str, str]]:
    """Call a function in parallel processes, which share the cores; yield (name, failure) in order of completion.

    Args:
        function: returns the reason of its failure, "" for none.
        calls: name -> keywords of the function.
        jobs: number of processes. The death of a process is the failure of one call.
    """
    if not calls:
        return
    with shared_cores(jobs), terminated_with_us(jobs, (function.__module__,)) as pool:
        names: dict[Future[str], str] = {
            pool.schedule(function, kwargs=dict(keywords)): name for name, keywords in calls.items()
        }
        for future in as_completed(names):
            died = isinstance(future.exception(), ProcessExpired)
            yield names[future], "its process died" if died else future.result()
