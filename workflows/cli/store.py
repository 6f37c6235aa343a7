"""`gnmreg store ...`: maintenance of published results."""

from typing import Annotated

from tyro.conf import arg

from workflows.cli.options import FarmOptions, RunName, StoreUrl

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
        for part in kept.retire(run, keep):
            print(f"{part}: {opened.forget(part)} rows deleted")
    finally:
        opened.close()
    return 0
