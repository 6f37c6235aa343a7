"""Commands that look after published results."""

import os
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg


def verify(store: Positional[Annotated[str, arg(metavar="STORE")]], /, tidy: bool = False) -> int:
    """Read every file of a store and compare it with the manifests. Exit code 1 if something is missing or altered.

    Args:
        store: The folder or URL.
        tidy: Delete files of attempts that nobody published and that are older than a day.
    """
    from workflows.records.store import Store

    opened = Store(store)
    found = opened.verify()
    for what, names in (("missing", found.missing), ("altered", found.altered), ("orphaned", found.orphaned)):
        for name in names:
            print(f"{what}: {name}")
    for name, why in found.unreadable.items():
        print(f"unreadable: {name}: {why}")
    if tidy:
        print(f"{opened.tidy()} orphaned files deleted")
    print(
        f"{found.artifacts} artifacts; {len(found.missing)} files missing, {len(found.altered)} altered, "
        f"{len(found.orphaned)} orphaned; {len(found.unreadable)} manifests unreadable"
    )
    return 0 if found.sound else 1


def retire(
    store: Positional[Annotated[str, arg(metavar="STORE")]],
    run: Positional[Annotated[str, arg(metavar="RUN")]],
    /,
    keep: Annotated[int, arg(metavar="N")],
    folder: Annotated[Path, arg(metavar="DIR")] = Path("."),
    db: Annotated[str | None, arg(metavar="URL")] = None,
) -> int:
    """Delete the results of a run's iterations but the last ones, and their rows in the queue.

    Args:
        store: The folder or URL.
        run: The run.
        keep: How many iterations to keep.
        folder: The farm's folder.
        db: The queue's database, as for worker.
    """
    from workflows.engine.client import Queue
    from workflows.engine.database import ENVIRONMENT, checked_url, default_url
    from workflows.records.store import Store

    opened = Queue(checked_url(db or os.environ.get(ENVIRONMENT) or default_url(folder)))
    try:
        for part in Store(store).retire(run, keep):
            print(f"{part}: {opened.forget(part)} rows deleted")
    finally:
        opened.close()
    return 0
