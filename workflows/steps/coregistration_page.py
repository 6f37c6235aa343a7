"""The page of a coregistration, which its steps keep up to date."""

import fcntl
import time
import traceback
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from datetime import UTC, datetime
from functools import wraps
from pathlib import Path
from typing import Any

from registration.storage.files import atomic_write_text
from registration.storage.records import read_json
from workflows.pages.coregistration import render_coregistration_page
from workflows.records.coregistration import CoregistrationPlan, CoregistrationState, write_state
from workflows.records.round_files import MANIFEST, PAGE, PLAN, find_round_files

PERIOD_S = 20.0  # least time between two versions on account of registrations, of which there are many
_DEPTH = 5  # of a product below the coregistration's folder, at most
StepFunction = Callable[..., dict[str, Any]]


def write_record(state: CoregistrationState) -> None:
    """Write `coregistration.json` and `index.html` into the plan's output folder, each in one rename."""
    write_state(state)
    write_page(state.plan.out)


def write_page(out: Path) -> None:
    """Write the page of the coregistration in a folder from its record and the files that exist.

    Raises:
        InputError: there is no record.
    """
    with _locked(out):
        record = read_json(out / MANIFEST, title=CoregistrationState.TITLE, fix=CoregistrationState.FIX)
        written = datetime.now(UTC).strftime("%Y-%m-%d %H:%M:%S")
        page = render_coregistration_page(record, find_round_files(out, record["plan"]), written)
        atomic_write_text(out / PAGE, page)


def shown_on_page(*, often: bool = False) -> Callable[[StepFunction], StepFunction]:
    """Return a decorator of steps: when one ends, in success or not, the page of its coregistration shows it.

    Steps write their product into the folder `out`, some levels below the coregistration's. Those that belong to none,
    such as those of `gnmreg debug`, write no page.

    Args:
        often: whether the step is one of many; then the page is not written again within `PERIOD_S`.
    """

    def decorate(step: StepFunction) -> StepFunction:
        @wraps(step)
        def run(**arguments: Any) -> dict[str, Any]:
            try:
                return step(**arguments)
            finally:
                try:
                    _refresh(Path(arguments["out"]), often)
                except Exception:  # a page must not cost a product
                    if (progress := arguments.get("progress")) is not None:
                        progress.message(traceback.format_exc())

        return run

    return decorate


def _refresh(product: Path, often: bool) -> None:
    for folder in product.parents[:_DEPTH]:
        if (folder / MANIFEST).is_file() and CoregistrationPlan.is_ours(folder / PLAN):
            page = folder / PAGE
            if not (often and page.is_file() and time.time() - page.stat().st_mtime < PERIOD_S):
                write_page(folder)
            return


@contextmanager
def _locked(out: Path) -> Iterator[None]:
    """Let one process at a time read what exists and write the page: else an older version could replace a newer one.

    The lock is advisory; where the file system or the folder has none, the page is right after the next step.
    """
    with ExitStack() as stack:
        with suppress(OSError):
            fcntl.flock(stack.enter_context((out / PLAN).open("rb")), fcntl.LOCK_EX)
        yield
