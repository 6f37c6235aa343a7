"""What children are asked to do in tests."""

import os
import signal
from pathlib import Path

from registration.errors import InputError
from registration.progress import Progress


def act(what: str, value: int, place: str, progress: Progress) -> tuple[int, int]:
    """Tells its process and twice the value, or fails in some way."""
    progress.note(f"asked to {what}")
    progress.at(1, 2, "acting")
    if what == "refuse":
        raise InputError("The lens is dirty", where="cam3", expected="a clean one", got="dust", fix="wipe it")
    if what == "raise":
        raise RuntimeError("out of luck\nand more")
    if what == "die" or (what == "die once" and not Path(place).exists()):
        Path(place).touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return os.getpid(), 2 * value


def threads(progress: Progress) -> str | None:
    return os.environ.get("OMP_NUM_THREADS")
