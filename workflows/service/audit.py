"""Who did what: JSON lines of all requests that change something, and of refused tokens; append-only."""

import json
import os
import threading
import time
from pathlib import Path
from typing import Any

FILE = "audit.jsonl"


class AuditLog:
    """The log `audit.jsonl` of a service."""

    def __init__(self, state: Path) -> None:
        """`state`: folder of the service's state."""
        self.file = state / FILE
        self._lock = threading.Lock()

    def append(self, *, who: str, what: str, **details: Any) -> None:
        """Append a line: time, name of the token or address of the client, what was done, and details."""
        line = json.dumps({"time": round(time.time(), 3), "who": who, "what": what, **details})
        with self._lock:
            self.file.parent.mkdir(parents=True, exist_ok=True, mode=0o700)
            descriptor = os.open(self.file, os.O_CREAT | os.O_WRONLY | os.O_APPEND, 0o600)
            try:
                os.write(descriptor, f"{line}\n".encode())
            finally:
                os.close(descriptor)
