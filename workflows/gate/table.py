"""The registrations at the gate as a table: CSV, counts, and one id of the accepted set."""

import csv
import hashlib
import io
from collections.abc import Sequence

from workflows.gate.figures import FIGURES
from workflows.gate.item import GateItem, Policy
from workflows.gate.rules import LEVELS
from workflows.records.batch import cell

_COLUMNS = (
    *("name", "content_id", "status", "verdict", "reasons", "unmeasured", "sampled", "decision", "who"),
    "accepted",
)


def to_csv(items: Sequence[GateItem], policy: Policy) -> str:
    """Return the text of a CSV file with a line of headers. Its cells cannot be taken for formulas.

    Args:
        items: of a run.
        policy: that says which are accepted.
    """
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow((*_COLUMNS, *FIGURES))
    for item in items:
        verdict, known, decision = item.verdict, item.figures.known(), item.decision
        words = [
            *(item.name, item.content_id, item.assessed.status, verdict.level, verdict.text),
            *(" ".join(verdict.unmeasured), "yes" if verdict.sampled else "no"),
            *((decision.decision, decision.who) if decision else ("", "")),
            "yes" if item.accepted(policy) else "no",
        ]
        numbers = [f"{known[name]:.6g}" if name in known else "" for name in FIGURES]
        writer.writerow((*map(cell, words), *numbers))
    return text.getvalue()


def counts(items: Sequence[GateItem]) -> dict[str, int]:
    """Return the numbers of registrations by verdict, in the order of the levels."""
    return {level: sum(item.verdict.level == level for item in items) for level in LEVELS}


def accepted_id(items: Sequence[GateItem], policy: Policy) -> str:
    """Return one digest of the accepted set: equal for equal sets, in any order."""
    accepted = sorted({item.content_id for item in items if item.accepted(policy)})
    return hashlib.sha256("\n".join(accepted).encode()).hexdigest()
