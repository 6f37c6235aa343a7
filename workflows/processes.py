"""Processes that end with the one that started them, however that ends, and share the machine's cores."""

import ctypes
import importlib
import os
import signal
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Future, as_completed
from contextlib import contextmanager
from multiprocessing import get_context
from typing import Any

from pebble import ProcessExpired, ProcessPool

_PR_SET_PDEATHSIG = 1
_THREADS = "OMP_NUM_THREADS"  # libraries read it as they are loaded; the renderer does too


def end_with(parent: int, number: signal.Signals = signal.SIGKILL) -> None:
    """In a child, first of all: ask Linux for this signal when the parent ends.

    The kernel means the *thread* that started the child: let that be one which lives as long as the process.
    """
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, number)
    if os.getppid() != parent:  # it ended before the line above
        os._exit(1)


def warm_pool(jobs: int = 1, modules: tuple[str, ...] = ()) -> ProcessPool:
    """Processes that end with this one and import `modules` when they start, not when their first job does."""
    return ProcessPool(
        max_workers=jobs,
        max_tasks=0,
        initializer=_born,
        initargs=(os.getpid(), modules),
        context=get_context("spawn"),  # a fork would share the threads of torch and Dr.Jit
    )


def _born(parent: int, modules: tuple[str, ...]) -> None:
    end_with(parent)
    for module in modules:
        importlib.import_module(module)
    # Whatever libraries put there since: die at once, without a word, even while the interpreter's lock is held.
    signal.signal(signal.SIGTERM, signal.SIG_DFL)


@contextmanager
def ending_with_us(jobs: int, modules: tuple[str, ...] = ()) -> Iterator[ProcessPool]:
    """A warm pool; whatever it is doing when the context is left is killed."""
    pool = warm_pool(jobs, modules)
    try:
        yield pool
    finally:
        pool.stop()
        pool.join()


def cores_each(jobs: int) -> str:
    """The value of OMP_NUM_THREADS that gives each of so many processes its share."""
    return str(max(1, (os.cpu_count() or 1) // max(1, jobs)))


@contextmanager
def share_of_cores(jobs: int) -> Iterator[None]:
    """Processes that are started meanwhile take their share of the cores, unless the environment says otherwise."""
    if jobs < 2 or _THREADS in os.environ:
        yield
        return
    os.environ[_THREADS] = cores_each(jobs)
    try:
        yield
    finally:
        del os.environ[_THREADS]


def side_by_side(
    function: Callable[..., str], calls: Mapping[str, Mapping[str, Any]], jobs: int
) -> Iterator[tuple[str, str]]:
    """Call a function that returns its trouble, "" for none, with each of some named sets of keywords.

    Yields (name, trouble) as they end. A death of one process is the trouble of one call. The cores are shared.
    """
    if not calls:
        return
    with share_of_cores(jobs), ending_with_us(jobs, (function.__module__,)) as pool:
        names: dict[Future[str], str] = {
            pool.schedule(function, kwargs=dict(keywords)): name for name, keywords in calls.items()
        }
        for future in as_completed(names):
            died = isinstance(future.exception(), ProcessExpired)
            yield names[future], "its process died" if died else future.result()
