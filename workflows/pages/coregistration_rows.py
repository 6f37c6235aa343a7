"""What the pages of a coregistration say of its record, `coregistration.json`, as texts and rows of tables."""

from collections.abc import Mapping, Sequence
from typing import Any

from workflows.records.round_files import HELD_OUT, RoundFiles, model_name

MISSING = "–"
ROUND_COLUMNS = (
    *("round", "registered", "failed", "left out by the gate", "outliers", "identity components", "drift, mm"),
    *("generalization, mm", "specificity, mm"),
)
_STEPS = ("stabilized expressions", "model", "evaluation")  # titles of products, in the order of the steps


def lead(record: Mapping[str, Any]) -> str:
    """Return the stopping rule's verdict in words."""
    verdict, stopped = record["verdict"], record.get("stopped", "")
    if stopped:
        return f"Stopped: {stopped}."
    if verdict is None:
        return "The first round is not done yet."
    return ("Continued: " if verdict["proceed"] else "Ended: ") + str(verdict["reason"]) + "."


def running_round(record: Mapping[str, Any]) -> str | None:
    """Return the name of the round that is not done, None after the last one."""
    verdict = record["verdict"]
    return f"it{len(record['rounds']):02d}" if verdict is None or verdict["proceed"] else None


def progress(running: str, record: Mapping[str, Any], files: Sequence[RoundFiles]) -> str:
    """Return what exists of the running round, in words."""
    by_name = {item.name: item for item in files}
    held_out = by_name.get(HELD_OUT)
    sentences = []
    if record["plan"]["without_truth"] and not record["rounds"] and not (held_out and held_out.products):
        done = 0 if held_out is None else held_out.reported
        total = sum(len(record["plan"]["captures"][name]) for name in record["plan"]["without_truth"])
        sentences.append(f"Held-out subjects: {done} of {total} captures have a report.")
    item = by_name.get(running)
    if item is None:
        return " ".join([*sentences, f"Of round {running} there is nothing yet."])
    titles = [title for title, _ in item.products]
    missing = [title for title in _STEPS if title not in titles]
    sentences.append(f"Round {running}: {item.reported} of {item.captures} captures have a report;")
    present = [title for title in _STEPS if title in titles]
    sentences.append(f"done: {', '.join(present) or 'nothing else'}; not done: {', '.join(missing) or 'the verdict'}.")
    return " ".join(sentences)


def round_row(number: int, row: Mapping[str, Any], record: Mapping[str, Any], components: str) -> list[str]:
    """Return a row of the table of rounds, with `ROUND_COLUMNS`."""
    captures = [capture for subject in row["register"].values() for capture in subject.values()]
    failed = sum(not capture["usable"] for capture in captures)
    built, model = row["build"], model_name(number)
    gated = MISSING if row.get("gate") is None else row["gate"]["left_out_count"]
    metrics = [record[name].get(model, {}).get(components) for name in ("generalization_mm", "specificity_mm")]
    return [
        row["name"],
        *map(str, (len(captures) - failed, failed, gated, len(built["rejected"]), built["components"])),
        f"{built['drift_mm']:.3f}",
        *(MISSING if value is None else f"{value:.3f}" for value in metrics),
    ]


def failures(rounds: list[Mapping[str, Any]]) -> list[tuple[str, str, str, str]]:
    """Return (round, registration, kind, reason) of all captures that no model uses."""
    rows = []
    for row in rounds:
        for subject, captures in row["register"].items():
            lost = [(name, capture["reason"]) for name, capture in captures.items() if not capture["usable"]]
            rows += [(row["name"], f"{subject}, {name}", "failed", reason) for name, reason in lost]
        rows += [(row["name"], outlier["name"], "left out", outlier["reason"]) for outlier in row["build"]["rejected"]]
    return rows
