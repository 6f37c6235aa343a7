"""Test steps: stand-ins for real steps that take milliseconds, and steps that fail in different ways."""

import ctypes
import os
import signal
import sys
import time
from pathlib import Path
from typing import Any

from registration.errors import InputError
from registration.progress import Progress
from workflows.engine.jobs import Step
from workflows.records.store import Store


def work(store: str, key: str, seconds: float = 0.0, trace: str | None = None) -> dict[str, Any]:
    """Sleep and publish an artifact; write a line to the trace at the start and at the end."""

    def make(folder: Path) -> dict[str, Any]:
        _trace(trace, f"begin {key} {os.getpid()}")
        time.sleep(seconds)
        (folder / "result.txt").write_text(key)
        _trace(trace, f"end {key} {os.getpid()}")
        return {"status": "converged", "seconds": seconds}

    artifact = Store(store).produce(key, input_hash=key, make=make)
    return {**artifact.brief(), "attempt": artifact.attempt}


def talk(text: str, progress: Progress) -> str:
    progress.message(text)
    progress.update(1, 2, "talking")
    print("from Python", file=sys.stderr)
    ctypes.CDLL(None).puts(b"from C")
    return text


def refuse() -> None:
    raise InputError("It is bad", where="here", expected="good", got="bad", fix="mend it")


def fail(trace: str | None = None) -> None:
    _trace(trace, "begin fail 0")
    raise ValueError("as asked, at postgresql://me:secret@host/db")


def leave() -> None:
    raise SystemExit(0)


def return_an_object() -> object:
    return object()


def return_much() -> str:
    return "x" * 1_000_000


def crash(trace: str | None = None) -> None:
    _trace(trace, "begin crash 0")
    os.kill(os.getpid(), signal.SIGSEGV)


def poison(trace: str) -> None:
    """Kill the worker itself."""
    _trace(trace, "begin poison 0")
    os.kill(os.getppid(), signal.SIGKILL)
    time.sleep(60)


def hold_gil(seconds: int, trace: str) -> str:
    _trace(trace, "begin gil 0")
    ctypes.PyDLL(None).sleep(seconds)  # called with the interpreter's lock held
    _trace(trace, "end gil 0")
    return "held"


def _trace(file: str | None, line: str) -> None:
    if file is not None:
        with open(file, "a") as stream:
            stream.write(line + "\n")


def _step(name: str, **settings: Any) -> Step:
    return Step(function=f"tests.workflows.farm.steps:{name}", **settings)


STEPS = {
    "work": _step("work", path_arguments=("store", "trace")),
    "brief": _step("work", path_arguments=("store", "trace"), timeout_s=1.0),
    "talk": _step("talk"),
    "refuse": _step("refuse"),
    "fail": _step("fail"),
    "crash": _step("crash"),
    "poison": _step("poison"),
    "hold_gil": _step("hold_gil"),
}
