"""A worker's child process: it runs steps, can be killed, prints into the job's log, and terminates with its parent.

A step may crash its process, hold the interpreter's lock or never end. The process that talks to the queue must survive
all of that, so it runs no step itself. Whatever happens becomes an outcome, a small dict:

    {"status": "done" | "bad input" | "unusable" | "failed" | "timed out" | "died" | "refused", "reason": str,
     "seconds": float, "result": what the step returned, only if done,
     "what": what is wrong in general, "where", "expected", "got", "fix": how to mend it; only of an `InputError`}
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
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from pebble import ProcessExpired, ProcessPool

from registration.errors import InputError
from registration.storage.files import FULL, DiskFull, disk_full
from workflows.engine.jobs import MAX_BYTES, PermanentStepError
from workflows.ids import redact
from workflows.processes import start_pool

StepOutcome = dict[str, Any]
RETRIED = ("failed", "died")  # repeating bad input or a timeout would end in the same way


class StepProcess:
    """The child process of one worker. It starts with the first `warm` or `run` and is reused until it is killed."""

    def __init__(self, *, modules: tuple[str, ...] = ()) -> None:
        """`modules` are imported when a child starts, not when its first job starts."""
        self._modules = modules
        self._pool: ProcessPool | None = None
        self._stopping = False

    def warm(self) -> int:
        """Start the child, wait until it is ready and return its process id.

        Call it in the main thread: the kernel signals an orphan when the *thread* that started it ends.
        """
        try:
            pid: int = self._schedule(os.getpid, (), None).result()
        except BrokenProcessPool:  # the last child died, and the pool noticed it after this call was put into it
            pid = self._schedule(os.getpid, (), None).result()
        return pid

    async def run(
        self, function: str, arguments: Mapping[str, Any], *, log: Path, timeout_s: float, title: str = "attempt"
    ) -> StepOutcome:
        """Run "module:name" in the child and return its outcome.

        Cancelling the awaiting task kills the child, and so does a run longer than `timeout_s`.

        Args:
            function: as in the table of steps.
            arguments: keywords of the function.
            log: file to which everything that it prints is appended, between two lines that say when and how it began
                and ended.
            timeout_s: time limit, seconds.
            title: of these lines.
        """
        started_s = time.monotonic()
        log.parent.mkdir(parents=True, exist_ok=True)
        _write_line(log, f"{title} begins")
        try:
            future = self._schedule(_call, (function, dict(arguments), str(log)), timeout_s)
            outcome = await asyncio.wrap_future(future)
        except TimeoutError:
            outcome = _outcome("timed out", f"took longer than {timeout_s:g} s and was killed")
        except ProcessExpired as error:
            outcome = _outcome("died", f"its process {_exit_reason(error.exitcode)}")
        except BrokenProcessPool as error:
            outcome = _outcome("died", f"its process could not be started: {error}")
        if self._stopping:
            await asyncio.Event().wait()  # `kill` ended the child: this is no outcome of the job
        seconds = round(time.monotonic() - started_s, 3)
        reason = f": {outcome['reason']}" if outcome["status"] in ("timed out", "died") else ""  # else it is above
        _write_line(log, f"{title} ends after {seconds:.1f} s, {outcome['status']}{reason}")
        return {**outcome, "seconds": seconds}

    def kill(self) -> None:
        """Kill the child; calls of `run` that wait for it never return."""
        self._stopping = True
        if self._pool is not None:
            self._pool.stop()
            self._pool.join()

    def _schedule(
        self, function: Callable[..., Any], arguments: tuple[Any, ...], timeout_s: float | None
    ) -> Future[Any]:
        if self._pool is None:
            self._pool = start_pool(modules=self._modules)
        try:
            return self._pool.schedule(function, args=arguments, timeout=timeout_s)
        except RuntimeError:  # the pool gives up when a child dies between jobs
            self._pool.stop()
            self._pool = start_pool(modules=self._modules)
            return self._pool.schedule(function, args=arguments, timeout=timeout_s)


class JsonlProgress:
    """A progress that appends JSON lines to a file beside the job's log."""

    def __init__(self, file: Path) -> None:
        self._file = file
        self._label, self._last = "", 0.0

    def message(self, text: str) -> None:
        self._line({"note": text})
        print(f"{time.strftime('%H:%M:%S')} {text}", flush=True)

    def update(self, done: int, total: int, label: str) -> None:
        now = time.monotonic()
        if label != self._label or now - self._last > 1.0:
            self._label, self._last = label, now
            self._line({"done": done, "total": total, "what": label})

    def _line(self, value: Mapping[str, Any]) -> None:
        with suppress(OSError), self._file.open("a") as file:  # no job fails because its progress cannot be written
            file.write(json.dumps({"time": round(time.time(), 3), **value}) + "\n")


def function_of(dotted: str) -> Callable[..., Any]:
    """Return the function that a "module:name" of the table of steps names."""
    module, _, name = dotted.partition(":")
    function: Callable[..., Any] = getattr(importlib.import_module(module), name)
    return function


def _call(dotted: str, arguments: dict[str, Any], log: str) -> StepOutcome:
    """Run one step in the child, with its output in the log."""
    with _redirect_output(log):
        try:
            function = function_of(dotted)
            if "progress" in inspect.signature(function).parameters:
                arguments = {**arguments, "progress": JsonlProgress(Path(log).with_suffix(".jsonl"))}
            inspect.signature(function).bind(**arguments)
        except (ImportError, AttributeError, TypeError) as error:
            print(traceback.format_exc(), flush=True)
            return _outcome("bad input", f"the step cannot be called with these arguments: {error}")
        try:
            return _done(function(**arguments))
        except InputError as error:
            print(error, flush=True)
            parts = {name: redact(getattr(error, name)) for name in ("what", "where", "expected", "got", "fix")}
            return {**_outcome("bad input", error.line), **parts}
        except PermanentStepError as error:
            print(error, flush=True)
            return _outcome("unusable", str(error))
        except BaseException as error:  # also SystemExit: no exit of a step may look like success
            if isinstance(error, OSError) and error.errno in FULL and not isinstance(error, DiskFull):
                error = disk_full(Path(log), error)
            with suppress(OSError):  # the log may be on the disk that is full
                print(redact(traceback.format_exc()), flush=True)
            first, *_ = str(error).splitlines() or [""]
            return _outcome("failed", f"{type(error).__name__}: {first}")


def _write_line(log: Path, text: str) -> None:
    with log.open("a", encoding="utf-8") as file:
        print(f"--- {time.strftime('%Y-%m-%d %H:%M:%S')} {text}", file=file)


def _done(result: Any) -> StepOutcome:
    try:
        size = len(json.dumps(result))
    except (TypeError, ValueError) as error:
        return _outcome("failed", f"the step's result is not JSON: {error}")
    if size > MAX_BYTES:
        return _outcome("failed", f"the step's result has {size} bytes, more than {MAX_BYTES}: store arrays in files")
    return {**_outcome("done", ""), "result": result}


def _outcome(status: str, reason: str) -> StepOutcome:
    return {"status": status, "reason": redact(reason)[:2000]}


def _exit_reason(exitcode: int) -> str:
    if exitcode < 0:
        try:
            return f"was killed by {signal.Signals(-exitcode).name}"
        except ValueError:
            return f"was killed by signal {-exitcode}"
    return f"ended with code {exitcode}"


@contextmanager
def _redirect_output(log: str) -> Iterator[None]:
    """Redirect the file descriptors of stdout and stderr to the log, so that output of C++ code lands there too."""
    flush = ctypes.CDLL(None).fflush

    def redirect(out: int, err: int) -> None:
        sys.stdout.flush()
        sys.stderr.flush()
        flush(None)
        os.dup2(out, 1)
        os.dup2(err, 2)

    saved = os.dup(1), os.dup(2)
    target = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o644)
    redirect(target, target)
    try:
        yield
    finally:
        redirect(*saved)
        for descriptor in (target, *saved):
            os.close(descriptor)
