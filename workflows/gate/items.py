"""The registrations of a run at the gate: figures, verdict, decision, and whether a model may be built from them."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from registration.capture.native import natural_key
from registration.errors import InputError
from registration.storage.registration_folder import MANIFEST, RegistrationManifest, is_registration, read_manifest
from workflows.engine.reader import DONE, FAILED, JobRow, QueueReader
from workflows.gate.decisions import DecisionEntry
from workflows.gate.figures import assess
from workflows.gate.item import GateItem, of_last_round
from workflows.gate.rules import GateThresholds, judge
from workflows.ids import check_id
from workflows.records.round_files import PLAN
from workflows.records.store import Store
from workflows.records.subject import is_subject_folder, read_subject

REGISTRATION = "registration"  # the folder within an attempt in a store
_ROUND = "it[0-9][0-9]*"  # folders of a coregistration's rounds


@dataclass(frozen=True, kw_only=True)
class Found:
    """A registration of a run, of which nothing but the manifest was read."""

    name: str
    place: str
    manifest: RegistrationManifest


def gate_items(
    found: Sequence[Found], thresholds: GateThresholds, decisions: Mapping[str, DecisionEntry]
) -> list[GateItem]:
    """Return the registrations with their verdicts and decisions, in the given order.

    Args:
        found: as `find_registrations` returns them.
        thresholds: of the rules.
        decisions: as `decisions.current` returns them.
    """
    items = []
    for registration in found:
        assessed = assess(registration.manifest)
        items.append(
            GateItem(
                name=registration.name,
                place=registration.place,
                assessed=assessed,
                verdict=judge(assessed, thresholds),
                decision=decisions.get(assessed.content_id),
            )
        )
    return items


def find_registrations(run: str, url: str | None = None) -> list[Found]:
    """Return the registrations of a run.

    Args:
        run: a registration folder; a subject's folder; a folder of such folders; the folder of a coregistration, of
            which the last round counts; a store's folder or URL; or the name of a run in the queue.
        url: of the queue; None: `run` is no name.

    Raises:
        InputError: there is nothing of that kind, or a record is malformed.
    """
    folder = Path(run)
    if "://" not in run and folder.is_dir():
        found = [*_in_folder(folder)] or [*_in_store(Store(folder))]
    elif "://" in run:
        found = [*_in_store(Store(run))]
    else:
        found = [] if url is None else [*_in_queue(run, url)]
    if not found:
        raise InputError(
            "There are no registrations",
            where=run,
            expected="a store, a folder of subjects' registrations, a coregistration's folder, or a run in the queue",
            got="none in it" if folder.is_dir() else "no such folder or run",
            fix="check the path, or name the farm with --folder",
        )
    return found


def subject_registrations(folder: Path, name: str) -> Iterator[Found]:
    """Yield the usable registrations in a subject's folder, the neutral's first; `name`: the subject's in names.

    Raises:
        InputError: a record is malformed.
    """
    record = read_subject(folder)
    for row in () if record is None else record.rows:
        if row.folder is not None and is_registration(folder / row.folder):
            place = folder / row.folder
            yield Found(name=f"{name}/{row.name}", place=str(place), manifest=read_manifest(place))


def _in_folder(folder: Path) -> Iterator[Found]:
    if is_registration(folder):
        yield Found(name=folder.name, place=str(folder), manifest=read_manifest(folder))
        return
    if is_subject_folder(folder):
        yield from subject_registrations(folder, folder.resolve().name)
        return
    if (folder / PLAN).is_file():
        rounds = sorted(path for path in folder.glob(_ROUND) if path.is_dir())
        folder = rounds[-1] / "registrations" if rounds else folder
    for path in _below(folder):
        if is_subject_folder(path):
            yield from subject_registrations(path, path.name)
        elif is_registration(path):
            yield Found(name=path.name, place=str(path), manifest=read_manifest(path))
        else:  # registrations of a subject without a record
            for one in _below(path):
                if is_registration(one):
                    yield Found(name=f"{path.name}/{one.name}", place=str(one), manifest=read_manifest(one))


def _below(folder: Path) -> list[Path]:
    """The folders in a folder, but for hidden ones, in natural order."""
    below = folder.iterdir() if folder.is_dir() else iter(())
    return sorted(
        (path for path in below if path.is_dir() and not path.name.startswith(".")),
        key=lambda path: natural_key(path.name),
    )


def _in_store(store: Store, below: str = "") -> Iterator[Found]:
    for key in store.keys(below):
        if (one := _published(store, key)) is not None:
            yield one


def _published(store: Store, key: str) -> Found | None:
    """The registration that is published under a key, if one is."""
    artifact = store.find(key)
    name = f"{REGISTRATION}/{MANIFEST}"
    if artifact is None or name not in artifact.files:
        return None
    place = f"{store.url.rstrip('/')}/{key}/{artifact.attempt}/{REGISTRATION}"
    return Found(
        name=key,
        place=place,
        manifest=RegistrationManifest.from_text(store.read(artifact, name), where=f"{place}/{MANIFEST}"),
    )


def _in_queue(run: str, url: str) -> Iterator[Found]:
    """The registrations of a run's jobs that have ended, also of those that failed with a registration."""
    stores: dict[str, Store] = {}
    jobs = {job.id: job for job in QueueReader(url).listing(check_id(run)) if "capture" in _arguments(job)}
    for job in (jobs[identity] for identity in of_last_round(list(jobs))):
        if job.state not in (DONE, FAILED):
            continue
        arguments = _arguments(job)
        if "store" in arguments and "key" in arguments:
            store = stores.setdefault(arguments["store"], Store(arguments["store"]))
            if (one := _published(store, check_id(arguments["key"]))) is not None:
                yield one
        elif "out" in arguments and is_registration(Path(arguments["out"])):
            place = Path(arguments["out"])
            name = f"{place.parent.name}/{place.name}"
            yield Found(name=name, place=str(place), manifest=read_manifest(place))


def _arguments(job: JobRow) -> dict[str, str]:
    """The arguments of a job that are texts; others can write to the queue."""
    arguments = job.spec.get("arguments")
    pairs = arguments.items() if isinstance(arguments, Mapping) else ()
    return {str(name): value for name, value in pairs if isinstance(value, str)}
