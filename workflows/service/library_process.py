"""A child process for work that needs the whole library: the service stays small, and survives what the work does."""

import importlib
import traceback
from concurrent.futures import ThreadPoolExecutor
from http import HTTPStatus
from typing import Any

from registration.errors import InputError
from registration.storage.files import DiskFull
from workflows.processes import ProcessExpired, ProcessPool, start_pool
from workflows.service.problems import Problem

TIMEOUT_S = 600.0


class LibraryProcess:
    """One child process, started with the first call and again after it died. Calls wait for one another."""

    def __init__(self, module: str) -> None:
        """`module`: of the functions that are called."""
        self._module = module
        # A child ends with the thread that started it: this one lives until `stop`, those of requests do not.
        self._thread = ThreadPoolExecutor(1, thread_name_prefix=module)
        self._pool: ProcessPool | None = None

    def call(self, function: str, /, **arguments: Any) -> Any:
        """Return what a function of the module returns, which is small and JSON.

        Raises:
            Problem: 422 for an `InputError` of the function, or if it takes too long or its process dies.
            RuntimeError: any other error; its traceback is in the message.
        """
        future = self._thread.submit(self._schedule, function, arguments).result()
        try:
            outcome = future.result()
        except TimeoutError:
            raise _refused(function, f"none within {TIMEOUT_S:.0f} s") from None
        except ProcessExpired as error:
            raise _refused(function, f"the process ended with code {error.exitcode}") from None
        if "result" in outcome:
            return outcome["result"]
        if "full" in outcome:
            raise DiskFull(*outcome["full"])
        if "error" in outcome:
            raise RuntimeError(outcome["error"])
        what = outcome["input"].pop("what")
        raise Problem.of_input(InputError(what, **outcome["input"]), HTTPStatus(outcome["status"]))

    def stop(self) -> None:
        """Kill the child. Calls that wait for it fail."""
        pool, self._pool = self._pool, None
        if pool is not None:
            pool.stop()
            pool.join()
        self._thread.shutdown()

    def _schedule(self, function: str, arguments: dict[str, Any]) -> Any:
        for again in (True, False):
            if self._pool is None:
                self._pool = start_pool(modules=(self._module,))
            try:
                return self._pool.schedule(_call, args=(self._module, function, arguments), timeout=TIMEOUT_S)
            except RuntimeError:  # the pool gives up when its child dies between calls
                if not again:
                    raise
                self._pool.stop()
                self._pool = None
        raise AssertionError("unreachable")


class Conflict(InputError):
    """Input that can be used, but not in the queue's present state."""

    def __init__(self, error: InputError) -> None:
        super().__init__(error.what, where=error.where, expected=error.expected, got=error.got, fix=error.fix)


def _call(module: str, function: str, arguments: dict[str, Any]) -> dict[str, Any]:
    """Call a function in the child; errors become an object, as not all of them can be sent."""
    try:
        return {"result": getattr(importlib.import_module(module), function)(**arguments)}
    except InputError as error:
        parts = {name: getattr(error, name) for name in ("what", "where", "expected", "got", "fix")}
        status = HTTPStatus.CONFLICT if isinstance(error, Conflict) else HTTPStatus.UNPROCESSABLE_ENTITY
        return {"input": parts, "status": int(status)}
    except DiskFull as error:
        return {"full": [error.errno, error.strerror, error.filename]}
    except Exception:
        return {"error": traceback.format_exc()}


def _refused(function: str, got: str) -> Problem:
    return Problem(
        HTTPStatus.UNPROCESSABLE_ENTITY,
        "The input stops the program that reads it",
        where=function,
        expected="an answer",
        got=got,
        fix="check the input with `gnmreg capture check` on your machine",
    )
