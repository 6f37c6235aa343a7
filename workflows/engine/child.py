"""A worker's warm child process: it runs steps, can be killed, prints into the job's log, and dies with its parent.

A step may crash its process, hold the interpreter's lock or never end. The process that talks to the queue must survive
all of that, so it runs no step itself. Whatever happens becomes an outcome, a small dict:

    {"status": "done" | "bad input" | "unusable" | "failed" | "timed out" | "died" | "refused", "reason": str,
     "seconds": float, "result": what the step returned, only if done}
"""

import asyncio
import ctypes
import importlib
import inspect
import json
import os
import signal
import sys
import time
import traceback
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Future
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from pebble import ProcessExpired, ProcessPool

from registration.errors import InputError
from workflows.engine.jobs import MAX_BYTES, PermanentStepError
from workflows.ids import redact
from workflows.processes import warm_pool

Outcome = dict[str, Any]
RETRIED = ("failed", "died")  # bad input stays bad, and what ran out of time once would again


class Slot:
    """The child process of one worker. It starts with the first `warm` or `run` and serves until it must be killed."""

    def __init__(self, *, modules: tuple[str, ...] = ()) -> None:
        """`modules` are imported when a child starts, not when its first job does."""
        self._modules = modules
        self._pool: ProcessPool | None = None
        self._stopping = False

    def warm(self) -> int:
        """Start the child, wait until it is ready and return its process id.

        Call it in the main thread: the kernel's signal to an orphan is sent when the *thread* that started it ends.
        """
        pid: int = self._scheduled(os.getpid, (), None).result()
        return pid

    async def run(self, function: str, arguments: Mapping[str, Any], *, log: Path, hard_s: float) -> Outcome:
        """Run "module:name" in the child, with everything that it prints appended to `log`.

        Cancelling the awaiting task kills the child; so does running longer than `hard_s`.
        """
        begun = time.monotonic()
        log.parent.mkdir(parents=True, exist_ok=True)
        try:
            future = self._scheduled(_call, (function, dict(arguments), str(log)), hard_s)
            outcome = await asyncio.wrap_future(future)
        except TimeoutError:
            outcome = _outcome("timed out", f"took longer than {hard_s:g} s and was killed")
        except ProcessExpired as error:
            outcome = _outcome("died", f"its process {_how(error.exitcode)}")
        except BrokenProcessPool as error:
            outcome = _outcome("died", f"its process could not be started: {error}")
        if self._stopping:
            await asyncio.Event().wait()  # the child was killed by us: that says nothing about the job
        if outcome["status"] in ("timed out", "died"):
            with log.open("a") as file:
                print(f"{outcome['status']}: {outcome['reason']}", file=file)
        return {**outcome, "seconds": round(time.monotonic() - begun, 3)}

    def kill(self) -> None:
        """End the child at once; `run`s that wait for it never return."""
        self._stopping = True
        if self._pool is not None:
            self._pool.stop()
            self._pool.join()

    def _scheduled(self, function: Callable[..., Any], arguments: tuple[Any, ...], hard_s: float | None) -> Future[Any]:
        if self._pool is None:
            self._pool = warm_pool(modules=self._modules)
        try:
            return self._pool.schedule(function, args=arguments, timeout=hard_s)
        except RuntimeError:  # the pool gives up when a child dies between jobs
            self._pool.stop()
            self._pool = warm_pool(modules=self._modules)
            return self._pool.schedule(function, args=arguments, timeout=hard_s)


class JsonlProgress:
    """A progress that appends lines of JSON to a file, for whoever watches the job."""

    def __init__(self, file: Path) -> None:
        self._file = file
        self._what, self._last = "", 0.0

    def note(self, text: str) -> None:
        self._line({"note": text})
        print(text, flush=True)

    def at(self, done: int, total: int, what: str) -> None:
        now = time.monotonic()
        if what != self._what or now - self._last > 1.0:
            self._what, self._last = what, now
            self._line({"done": done, "total": total, "what": what})

    def _line(self, value: Mapping[str, Any]) -> None:
        with self._file.open("a") as file:
            file.write(json.dumps({"time": round(time.time(), 3), **value}) + "\n")


def function_of(dotted: str) -> Callable[..., Any]:
    """The function that a "module:name" of the table of steps means."""
    module, _, name = dotted.partition(":")
    function: Callable[..., Any] = getattr(importlib.import_module(module), name)
    return function


def _call(dotted: str, arguments: dict[str, Any], log: str) -> Outcome:
    """In the child: one step, its outcome, its prints in the log."""
    with _printing_to(log):
        try:
            function = function_of(dotted)
            if "progress" in inspect.signature(function).parameters:
                arguments = {**arguments, "progress": JsonlProgress(Path(log).with_suffix(".jsonl"))}
            inspect.signature(function).bind(**arguments)
        except (ImportError, AttributeError, TypeError) as error:
            print(traceback.format_exc(), flush=True)
            return _outcome("bad input", f"the step cannot be called so: {error}")
        try:
            return _done(function(**arguments))
        except InputError as error:
            print(error, flush=True)
            return _outcome("bad input", error.line)
        except PermanentStepError as error:
            print(error, flush=True)
            return _outcome("unusable", str(error))
        except BaseException as error:  # also SystemExit: nothing that a step does may look like success
            print(redact(traceback.format_exc()), flush=True)
            first, *_ = str(error).splitlines() or [""]
            return _outcome("failed", f"{type(error).__name__}: {first}")


def _done(result: Any) -> Outcome:
    try:
        size = len(json.dumps(result))
    except (TypeError, ValueError) as error:
        return _outcome("failed", f"the step's result is not JSON: {error}")
    if size > MAX_BYTES:
        return _outcome("failed", f"the step's result has {size} bytes, more than {MAX_BYTES}: store arrays in files")
    return {**_outcome("done", ""), "result": result}


def _outcome(status: str, reason: str) -> Outcome:
    return {"status": status, "reason": redact(reason)[:2000]}


def _how(exitcode: int) -> str:
    if exitcode < 0:
        try:
            return f"was killed by {signal.Signals(-exitcode).name}"
        except ValueError:
            return f"was killed by signal {-exitcode}"
    return f"ended with code {exitcode}"


@contextmanager
def _printing_to(log: str) -> Iterator[None]:
    """Point the file descriptors of stdout and stderr at the log, so that what C++ prints lands there too."""
    flush = ctypes.CDLL(None).fflush

    def turn(out: int, err: int) -> None:
        sys.stdout.flush()
        sys.stderr.flush()
        flush(None)
        os.dup2(out, 1)
        os.dup2(err, 2)

    kept = os.dup(1), os.dup(2)
    target = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o644)
    turn(target, target)
    try:
        yield
    finally:
        turn(*kept)
        for descriptor in (target, *kept):
            os.close(descriptor)
