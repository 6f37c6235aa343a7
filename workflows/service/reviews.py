"""Pages of the stabilization review, each a child process on the loopback interface with a limited life."""

import os
import shlex
import signal
import subprocess
import sys
import threading
import time
from collections import deque
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from http import HTTPStatus
from pathlib import Path

from registration.terminal import printable
from workflows.processes import terminate_with_parent
from workflows.service.problems import Problem

LIFE_S = 2 * 3600.0  # of a page
START_S = 180.0  # within which it listens: a set that is not stabilized yet may take longer, and is asked for again
MAX_PAGES = 4
_OPEN = "Open "  # what the command prints before the address


@dataclass
class _Page:
    """A child, and what it has printed."""

    process: "subprocess.Popen[str]"
    started_s: float = field(default_factory=time.monotonic)
    address: str = ""
    lines: deque[str] = field(default_factory=lambda: deque(maxlen=6))  # the last ones of its output
    listens: threading.Event = field(default_factory=threading.Event)

    @property
    def said(self) -> str | None:
        """The end of its output."""
        return printable(" ".join(filter(None, self.lines)))[:800] or None

    def read(self) -> None:
        """Wait for the address, then drop what else is printed."""
        for line in self.process.stdout or ():
            self.lines.append(line.strip())
            if line.startswith(_OPEN):
                self.address = line.removeprefix(_OPEN).split()[0]
                self.listens.set()
        self.listens.set()


class Reviews:
    """The review pages of one service."""

    def __init__(self) -> None:
        """Nothing is started before `open`."""
        # A child ends with the thread that started it: this one lives until `stop`, those of requests do not.
        self._starter = ThreadPoolExecutor(1, thread_name_prefix="reviews")
        self._pages: dict[Path, _Page] = {}
        self._lock = threading.Lock()

    def open(self, run: Path, model: Path) -> str:
        """Return the address of the page that reviews a run, with the token that it asks for; it is started if needed.

        Args:
            run: folder of the subjects' registrations.
            model: their head model.

        Raises:
            Problem: 409 if too many pages are open or the page could not start, 503 if it is still starting.
        """
        with self._lock:
            self._end_old()
            page = self._pages.get(run)
            if page is None:
                if len(self._pages) >= MAX_PAGES:
                    expected = f"at most {MAX_PAGES} reviews at a time"
                    fix = "close one, or wait: each ends after two hours"
                    raise Problem(HTTPStatus.CONFLICT, "Too many reviews are open", expected=expected, fix=fix)
                page = self._pages[run] = self._starter.submit(_start, review_command(run, model)).result()
                threading.Thread(target=page.read, name="review", daemon=True).start()
        page.listens.wait(START_S)
        if page.address:
            return page.address
        if not page.listens.is_set():
            detail = "The set is still being prepared"
            raise Problem(HTTPStatus.SERVICE_UNAVAILABLE, detail, got=page.said, fix="ask again in a minute")
        fix = f"run the command in a terminal: gnmreg {shlex.join(_arguments(run, model))}"
        raise Problem(HTTPStatus.CONFLICT, "The review could not start", got=page.said, fix=fix)

    def stop(self) -> None:
        """End all pages."""
        with self._lock:
            for page in self._pages.values():
                _end(page)
            self._pages.clear()
        self._starter.shutdown()

    def _end_old(self) -> None:
        for run, page in tuple(self._pages.items()):
            if page.process.poll() is not None or time.monotonic() - page.started_s > LIFE_S:
                _end(page)
                del self._pages[run]


def review_command(run: Path, model: Path) -> list[str]:
    """Return the command of a review's page."""
    return [sys.executable, "-m", "workflows.cli", *_arguments(run, model), "--port", "0"]


def _arguments(run: Path, model: Path) -> list[str]:
    return ["stabilize", "review", str(run), "--model", str(model), "--skip-failed"]


def _start(command: Sequence[str]) -> _Page:
    parent = os.getpid()
    process = subprocess.Popen(
        command,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        errors="replace",
        start_new_session=True,
        preexec_fn=lambda: terminate_with_parent(parent, signal.SIGTERM),
    )
    timer = threading.Timer(LIFE_S, process.terminate)
    timer.daemon = True
    timer.start()
    return _Page(process)


def _end(page: _Page) -> None:
    page.process.terminate()
    try:
        page.process.wait(5.0)
    except subprocess.TimeoutExpired:
        page.process.kill()
        page.process.wait()
