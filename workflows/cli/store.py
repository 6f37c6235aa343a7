"""`gnmreg store ...`: maintenance of published results."""

from typing import Annotated

from tyro.conf import arg

from registration.errors import InputError
from workflows.cli.options import FarmOptions, RunName, StoreUrl
from workflows.ids import nearest, redact

_FARM = FarmOptions()


def verify(store: StoreUrl, /, tidy: bool = False) -> int:
    """Compare every file of a store with the manifests.

    The exit code is 1 if a file is missing or altered, 2 if there is no such store.

    Args:
        store: The folder or URL.
        tidy: Delete unpublished attempts' files that are older than a day.
    """
    from workflows.records.store import Store

    opened = Store(store)
    opened.require()
    report = opened.verify()
    for kind, names in (("missing", report.missing), ("altered", report.altered), ("orphaned", report.orphaned)):
        for name in names:
            print(f"{kind}: {name}")
    for name, reason in report.unreadable.items():
        print(f"unreadable: {name}: {reason}")
    if tidy:
        print(f"{opened.tidy()} orphaned files deleted")
    print(
        f"{report.artifacts} artifacts; {len(report.missing)} files missing, {len(report.altered)} altered, "
        f"{len(report.orphaned)} orphaned; {len(report.unreadable)} manifests unreadable"
    )
    return 0 if report.is_sound else 1


def retire(
    store: StoreUrl,
    run: RunName,
    /,
    keep: Annotated[int, arg(metavar="N")],
    farm: FarmOptions = _FARM,
) -> int:
    """Delete the results of a run's earlier rounds, and their jobs in the queue.

    Args:
        store: The folder or URL.
        run: The run.
        keep: Number of rounds to keep, the last ones.
        farm: Which farm.
    """
    from workflows.engine.client import QueueClient
    from workflows.records.store import Store

    kept = Store(store)
    kept.require()
    opened = QueueClient(farm.url)
    try:
        retired = kept.retire(run, keep)
        for part in retired:
            print(f"{part}: {opened.forget(part)} rows deleted")
    finally:
        opened.close()
    runs = {key.partition("/")[0] for key in kept.keys()} if not retired else {run}
    if run not in runs:
        near = nearest(run, runs) or sorted(runs)[:10]
        raise InputError(
            "There is no such run in the store",
            where=redact(store),
            expected=f"one of {', '.join(near)}" if near else "a store with results of runs",
            got=run,
            fix="correct the name",
        )
    if not retired:
        print(f"nothing to delete: {run} has no more than {keep} rounds here")
    return 0
