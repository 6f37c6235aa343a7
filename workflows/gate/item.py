"""One registration at the gate, and the gate's own error: importing it loads no numeric library."""

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from workflows.gate.decisions import DecisionEntry
from workflows.gate.figures import Assessed, GateFigures
from workflows.gate.rules import Verdict

Policy = Literal["auto", "person"]
TAIL = 0.025  # on either side of an interval of 95 %
_OF_ROUND = re.compile(r"[^/]+/(?P<part>it[0-9]{2,}|held)/s[0-9]{5}-[^/]+/[^/]+")  # id of a registration's job


@dataclass(frozen=True, kw_only=True)
class GateItem:
    """One registration at the gate."""

    name: str  # SUBJECT/CAPTURE, or its key in a store
    place: str  # folder or URL of the registration
    assessed: Assessed
    verdict: Verdict
    decision: DecisionEntry | None = None  # that holds

    @property
    def content_id(self) -> str:
        """Of the registration: what decisions are bound to."""
        return self.assessed.content_id

    @property
    def figures(self) -> GateFigures:
        return self.assessed.figures

    @property
    def waits(self) -> bool:
        """Whether a person is asked and has not decided."""
        return self.decision is None and self.verdict.for_person

    def accepted(self, policy: Policy) -> bool:
        """Return whether a model may be built from it: a decision beats the verdict.

        Args:
            policy: "auto": what is to be looked at is used until a person rejects it. "person": it is not used until
                a person accepts it.
        """
        if self.decision is not None:
            return self.decision.decision == "accept"
        return self.verdict.level == "accept" or (self.verdict.level == "look" and policy == "auto")


@dataclass(frozen=True, kw_only=True)
class GateError:
    """The gate's own error, from the accepted that a person was shown: the share that the person rejected."""

    shown: int  # decided by a person
    rejected: int
    low: float  # bounds of the share, 95 %, exact [Clopper 1934]
    high: float

    @property
    def share(self) -> float:
        return self.rejected / self.shown if self.shown else math.nan

    @property
    def text(self) -> str:
        """What people are told."""
        return (
            f"of {self.shown} accepted ones that a person was shown, {self.rejected} were rejected: "
            f"{self.share:.1%} of the accepted are wrong (95 %: {self.low:.1%} to {self.high:.1%})"
        )


def gate_error(items: Sequence[GateItem]) -> GateError | None:
    """Return the gate's own error, from the sample of the accepted; None: no person has decided about any of it."""
    decided = [item.decision for item in items if item.verdict.sampled and item.decision is not None]
    shown, rejected = len(decided), sum(entry.decision == "reject" for entry in decided)
    if not shown:
        return None
    low = _share_at(rejected - 1, shown, 1 - TAIL) if rejected else 0.0
    high = _share_at(rejected, shown, TAIL) if rejected < shown else 1.0
    return GateError(shown=shown, rejected=rejected, low=low, high=high)


def _share_at(most: int, shown: int, probability: float) -> float:
    """The share of wrong ones with which at most so many of those shown are wrong with a probability: bisected."""
    low, high = 0.0, 1.0
    for _ in range(50):
        share = (low + high) / 2
        low, high = (share, high) if _at_most(most, shown, share) > probability else (low, share)
    return (low + high) / 2


def _at_most(most: int, shown: int, share: float) -> float:
    """The probability that at most so many of those shown are wrong: the binomial distribution."""
    logs = math.log(share), math.log1p(-share)
    return sum(
        math.exp(
            math.lgamma(shown + 1)
            - math.lgamma(k + 1)
            - math.lgamma(shown - k + 1)
            + k * logs[0]
            + (shown - k) * logs[1]
        )
        for k in range(most + 1)
    )


def of_last_round(jobs: Sequence[str]) -> list[str]:
    """Return which registrations of a run are at the gate: of a coregistration those of its last round, else all.

    Args:
        jobs: ids of the run's jobs that register captures.
    """
    found = [_OF_ROUND.fullmatch(job) for job in jobs]
    parts = [match["part"] for match in found if match is not None]
    if len(parts) < len(jobs):
        return list(jobs)
    last = max((part for part in parts if part != "held"), key=lambda part: int(part[2:]), default="held")
    return [job for job, part in zip(jobs, parts, strict=True) if part == last]
