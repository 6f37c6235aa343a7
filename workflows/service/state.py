"""What the routes of a service share."""

import os
import time
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from threading import Lock, Thread
from typing import Annotated

from fastapi import Depends, Request

from workflows.engine.metrics import QueueMetrics, metrics_of
from workflows.engine.reader import QueueReader
from workflows.service.access import Access
from workflows.service.audit import AuditLog
from workflows.service.board import Board
from workflows.service.gate_book import GateBook
from workflows.service.idempotency import Answers
from workflows.service.library_process import LibraryProcess
from workflows.service.places import Places
from workflows.service.reviews import Reviews
from workflows.service.settings import RESULTS, ServiceSettings
from workflows.service.tokens import Tokens
from workflows.service.uploads import Uploads

SIZE_S = 300.0  # between two counts of the results' bytes
METRICS_S = 2.0  # for which the figures of the queue are kept


@dataclass(frozen=True)
class _Kept:
    until: float
    metrics: QueueMetrics


class StoreSize:
    """Bytes of the results in the farm's folder, counted by a thread: there may be millions of files."""

    def __init__(self, folder: Path) -> None:
        """`folder`: of the results."""
        self._folder, self._bytes, self._until, self._lock = folder, 0, 0.0, Lock()

    def bytes(self) -> int:
        """Return the last count, and start another one if it is old."""
        with self._lock:
            if time.monotonic() > self._until:
                self._until = time.monotonic() + SIZE_S
                Thread(target=self._count, name="store size", daemon=True).start()
        return self._bytes

    def _count(self) -> None:
        total = 0
        for folder, _, names in os.walk(self._folder):
            for name in names:
                with suppress(OSError):
                    total += os.lstat(os.path.join(folder, name)).st_size
        self._bytes = total


class ServiceState:
    """The parts of a running service."""

    def __init__(self, settings: ServiceSettings) -> None:
        """Open the queue, which `migrate` created, and the folder of the service's state."""
        self.settings = settings
        self.places = Places(settings)
        self.uploads = Uploads(settings)
        self.submitting = LibraryProcess("workflows.service.submitting")
        self.answers = Answers(settings.state)
        self.tokens = Tokens(settings.state)
        self.audit = AuditLog(settings.state)
        self.access = Access(settings, self.tokens, self.audit)
        self.board = Board(settings.url, settings.poll_s)
        self.reader = QueueReader(settings.url, known=True)
        self.reviews = Reviews()
        self.gate = GateBook(settings.folder)
        self.store_size = StoreSize(settings.folder / RESULTS)
        self._metrics: dict[str, _Kept] = {}
        self._lock = Lock()

    def start(self) -> None:
        """Read the queue and follow it; delete what a service that was killed has left."""
        self.uploads.start()
        self.board.start()

    def stop(self) -> None:
        """End threads and child processes."""
        self.board.stop()
        self.gate.stop()
        self.uploads.stop()
        self.reviews.stop()
        self.submitting.stop()

    def metrics(self, run: str | None = None) -> QueueMetrics:
        """Return the figures of a run, or of the whole queue; at most two seconds old."""
        key = run or ""
        with self._lock:
            kept = self._metrics.get(key)
            if kept is None or kept.until < time.monotonic():
                rows = [entry.times for entry in self.board.entries.values() if run is None or entry.run == run]
                kept = _Kept(time.monotonic() + METRICS_S, metrics_of(self.reader, rows))
                self._metrics = {name: old for name, old in self._metrics.items() if old.until > time.monotonic()}
                self._metrics[key] = kept
            return kept.metrics


def service(request: Request) -> ServiceState:
    """Return the state of the service that answers a request: a dependency of routes."""
    state: ServiceState = request.app.state.service
    return state


Service = Annotated[ServiceState, Depends(service)]  # a parameter of routes
