"""`gnmreg gate ...`: verdicts on registrations, decisions of persons, and their log."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from tyro.conf import Positional, arg

from registration.errors import InputError
from workflows.cli.options import FarmOptions, OptionalFile

if TYPE_CHECKING:
    from workflows.gate.item import GateItem
    from workflows.gate.rules import GateThresholds

Runs = Positional[Annotated[tuple[str, ...], arg(metavar="RUN", help_behavior_hint="(required)")]]
Run = Positional[Annotated[str, arg(metavar="RUN")]]
Registration = Positional[Annotated[str, arg(metavar="NAME|CONTENT_ID")]]
Choice = Positional[Annotated[Literal["accept", "reject", "undo"], arg(metavar="accept|reject|undo")]]
Head = Annotated[str | None, arg(metavar="SHA256", help_behavior_hint="(optional)")]
_FARM = FarmOptions()
_SHORT = 12  # letters of a content id in tables


@dataclass(frozen=True, kw_only=True)
class GateOptions:
    """The rules of the gate.

    Attributes:
        thresholds: Limits of the rules, as `gnmreg gate calibrate` writes them. By default those of the farm,
            gate/thresholds.json in its folder, or built-in ones.
        policy: What becomes of a registration that is for a person. auto: it is used until a person rejects it.
            person: it is not used until a person accepts it.
    """

    thresholds: Annotated[Path | None, arg(metavar="FILE", help_behavior_hint="(default: the farm's)")] = None
    policy: Literal["auto", "person"] = "auto"


_GATE = GateOptions()


def verdicts(runs: Runs, /, out: OptionalFile = None, gate: GateOptions = _GATE, farm: FarmOptions = _FARM) -> int:
    """List registrations with the verdicts of the gate, their reasons and decisions.

    Args:
        runs: Names of runs in the queue, stores, or folders of subjects' registrations or of coregistrations.
        out: Write all figures as CSV.
        gate: The rules of the gate.
        farm: Which farm: its queue, and its log of decisions.
    """
    from workflows.gate.item import gate_error
    from workflows.gate.table import counts, to_csv

    if out is not None:
        _check_file(out)
    items = _items(runs, gate, farm)
    for item in items:
        decided = f"; {item.decision.who}: {item.decision.decision}" if item.decision else ""
        sampled = "; in the sample of the accepted" if item.verdict.sampled else ""
        print(
            f"{item.content_id[:_SHORT]}  {item.verdict.level:<6}  {item.name}  {item.verdict.text}{sampled}{decided}"
        )
    shown = ", ".join(f"{count} {level}" for level, count in counts(items).items())
    accepted, waiting = sum(item.accepted(gate.policy) for item in items), sum(item.waits for item in items)
    print(f"{len(items)} registrations: {shown}; {accepted} may be used, {waiting} wait for a person")
    if (error := gate_error(items)) is not None:
        print(error.text)
    if out is not None:
        _write(out, to_csv(items, gate.policy))
    return 0


def decide(
    run: Run,
    registration: Registration,
    choice: Choice,
    /,
    reason: Annotated[str, arg(metavar="TEXT")] = "",
    who: Annotated[str | None, arg(metavar="NAME", help_behavior_hint="(default: the user)")] = None,
    gate: GateOptions = _GATE,
    farm: FarmOptions = _FARM,
) -> int:
    """Record a person's decision about a registration in the farm's signed log.

    Args:
        run: A run in the queue, a store, or a folder of registrations.
        registration: The registration's name, or the beginning of its content id.
        choice: accept: use it. reject: never use it. undo: what held before the last decision holds again.
        reason: Why, in a few words that others will understand.
        who: Name of the person who decides.
        gate: The rules of the gate, whose verdict is recorded.
        farm: Which farm.
    """
    from workflows.gate.decisions import DecisionLog, Ruling
    from workflows.records.decisions import user_name

    item = _named(_items([run], gate, farm), registration, run)
    ruling = Ruling(
        content_id=item.content_id,
        name=item.name,
        decision=choice,
        reason=reason,
        who=who or user_name(),
        thresholds=_thresholds(gate, farm).content_id,
        verdict=item.verdict.level,
    )
    entry = DecisionLog.of_farm(farm.directory).append(ruling)
    print(f"{entry.sequence}: {entry.decision} {entry.name} ({entry.content_id[:_SHORT]})")
    return 0


def calibrate(
    runs: Runs,
    /,
    labels: Annotated[Path, arg(metavar="CSV")],
    out: Annotated[Path, arg(metavar="JSON")],
    gate: GateOptions = _GATE,
    farm: FarmOptions = _FARM,
) -> int:
    """Propose thresholds from registrations that a person has labelled good or bad.

    Beside the thresholds a page with the ROC curves of all rules is written.

    Args:
        runs: Names of runs in the queue, stores, or folders of subjects' registrations or of coregistrations.
        labels: A table with the columns name and label: a registration's name or content id, and good or bad. Label a
            random choice of the registrations; fifty are enough if ten of them are bad.
        out: The file of the thresholds.
        gate: The rules of the gate; the sample share and the seed of the thresholds are kept.
        farm: Which farm: its queue.
    """
    from dataclasses import replace

    from workflows.gate.calibrate import calibrate, labelled, read_labels
    from workflows.pages.gate_calibration import render_gate_calibration

    page = out.with_suffix(".html")
    for file in (out, page):
        _check_file(file)
    examples = labelled(_items(runs, gate, farm), read_labels(labels), labels)
    result = calibrate(examples, replace(_thresholds(gate, farm), name=out.stem))
    found = result.thresholds.calibration
    assert found is not None
    result.thresholds.write(out)
    _write(page, render_gate_calibration(result.view))
    print(out)
    print(
        f"{100 * found.recall:.0f} % of {found.bad} bad ones and {100 * found.false_alarms:.0f} % of {found.good} good "
        "ones are not accepted, each judged by thresholds from the other labels"
    )
    return 0


def verify(farm: FarmOptions = _FARM, repair: bool = False, head: Head = None) -> int:
    """Check the chain and all signatures of the log of decisions, and print its head.

    Args:
        farm: Which farm.
        repair: Put an unfinished last line, which a crash has left, aside into a file of its own.
        head: sha256 of a line that must be in the log, as an earlier call or a model's manifest names it: a log from
            which lines were cut off at the end is valid otherwise.
    """
    from hashlib import sha256

    from workflows.gate.decisions import START, DecisionLog

    log = DecisionLog.of_farm(farm.directory)
    if not log.exists():
        raise InputError(
            "There is no log of decisions",
            where=log.file,
            expected="the log of a farm in which something was decided",
            got="no such file",
            fix="name the farm's folder with --folder",
        )
    if repair and (aside := log.repair()) is not None:
        print(f"the unfinished line is in {aside}")
    found = log.verify()
    if head is not None and head != START:
        if not any(sha256(entry.line()).hexdigest() == head for entry in log.read()):
            raise InputError(
                "The log of the gate's decisions lacks entries",
                where=log.file,
                expected=f"a line with sha256 {head}",
                got=f"{found.sequence} other lines",
                fix="restore the log from a backup",
            )
    print(f"{found.sequence} entries, all signed; head {found.sha256}")
    return 0


def replay(
    run: Run,
    /,
    decisions: OptionalFile = None,
    out: OptionalFile = None,
    gate: GateOptions = _GATE,
    farm: FarmOptions = _FARM,
) -> int:
    """Apply rules and recorded decisions again, and print the accepted set.

    No person is asked: the same registrations, thresholds and decisions give the same set, whose id is printed.

    Args:
        run: A run in the queue, a store, or a folder of registrations.
        decisions: A log, with `key.pub` beside it, instead of the farm's.
        out: Write all figures as CSV.
        gate: The rules of the gate.
        farm: Which farm.
    """
    from workflows.gate.table import accepted_id, to_csv

    if out is not None:
        _check_file(out)
    items = _items([run], gate, farm, decisions)
    for item in items:
        if item.accepted(gate.policy):
            print(f"{item.content_id}  {item.name}")
    accepted = sum(item.accepted(gate.policy) for item in items)
    print(f"{accepted} of {len(items)} accepted, set {accepted_id(items, gate.policy)}")
    if out is not None:
        _write(out, to_csv(items, gate.policy))
    return 0


def _thresholds(gate: GateOptions, farm: FarmOptions) -> "GateThresholds":
    from workflows.gate.rules import read_thresholds

    return read_thresholds(gate.thresholds, farm.directory)


def _items(
    runs: Sequence[str], gate: GateOptions, farm: FarmOptions, decisions: Path | None = None
) -> "list[GateItem]":
    from workflows.gate.decisions import DecisionLog, current, read_log
    from workflows.gate.items import find_registrations, gate_items

    if not runs:
        raise InputError("There is no run", where="RUN", expected="one or more runs", got="none", fix="name a run")
    thresholds = _thresholds(gate, farm)
    entries = DecisionLog.of_farm(farm.directory).read() if decisions is None else read_log(decisions)
    found = [one for run in runs for one in find_registrations(run, _queue(farm))]
    return gate_items(found, thresholds, current(entries))


def _queue(farm: FarmOptions) -> str | None:
    """The queue's URL; None if there is no queue, which folders and stores do not need."""
    from workflows.engine.database import require_queue

    try:
        url = farm.url
        require_queue(url)
    except InputError:
        return None
    return url


def _named(items: "Sequence[GateItem]", name: str, run: str) -> "GateItem":
    exact = [item for item in items if item.name == name]
    found = exact or [item for item in items if len(name) >= 6 and item.content_id.startswith(name)]
    if len({item.content_id for item in found}) == 1:
        return found[0]
    from workflows.ids import nearest

    close = ", ".join(nearest(name, [item.name for item in items]))
    raise InputError(
        "There are several such registrations" if found else "There is no such registration",
        where=run,
        expected="a registration's name, or the beginning of one's content id, at least six letters",
        got=name,
        fix=f"similar: {close}" if close else "`gnmreg gate verdicts` lists them",
    )


def _check_file(file: Path) -> None:
    from registration.storage.files import check_output_file

    check_output_file(file)


def _write(file: Path, text: str) -> None:
    from registration.storage.files import atomic_write_text

    atomic_write_text(file, text)
    print(file)
