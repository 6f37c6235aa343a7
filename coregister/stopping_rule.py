"""Stopping rule of coregistration: whether another round is expected to improve the model. A pure function of rounds.

See docs/coregistration.md, "When it stops".
"""

from collections.abc import Sequence
from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True)
class RoundMetrics:
    """What the rule needs of a round of registration, model building and evaluation."""

    generalization_mm: float  # of the model that the round built, on held-out subjects
    drift_mm: float  # rms distance between the stable skin of the round's input template and of its output template
    registered: int  # registrations in the model
    failed: int  # registrations that failed, were left out by the quality gate, or rejected as outliers


@dataclass(frozen=True, kw_only=True)
class StoppingRule:
    """Limits of the rule.

    Attributes:
        max_rounds: number of rounds.
        min_gain: stop if a round reduces the generalization error by less than this fraction.
        max_drift_ratio: stop if the drift exceeds this multiple of the previous round's, and
        min_drift_mm: exceeds this distance.
        max_failure_rate: stop if more than this fraction of the registrations failed or was rejected.
        early_stopping: apply the limits of gain and drift.
    """

    max_rounds: int = 3
    min_gain: float = 0.02
    max_drift_ratio: float = 1.5
    min_drift_mm: float = 0.1
    max_failure_rate: float = 0.2
    early_stopping: bool = True


@dataclass(frozen=True, kw_only=True)
class StoppingVerdict:
    """Whether to proceed with another round, and why."""

    proceed: bool
    reason: str


def apply_stopping_rule(
    first_mm: float, rounds: Sequence[RoundMetrics], rule: StoppingRule | None = None
) -> StoppingVerdict:
    """Decide whether another round is worth its time.

    Failures are checked first, then drift, then gain, then the number of rounds.

    Args:
        first_mm: generalization of the model that the first round started from.
        rounds: all rounds so far.
        rule: limits.

    Raises:
        ValueError: there is no round.
    """
    rule = rule or StoppingRule()
    if not rounds:
        raise ValueError("the stopping rule needs at least one round")
    last = rounds[-1]
    failure_rate = last.failed / max(last.failed + last.registered, 1)
    if failure_rate > rule.max_failure_rate:
        return _stop(f"too many failures: {100 * failure_rate:.0f} % of the registrations")
    if rule.early_stopping and len(rounds) > 1:
        before = rounds[-2].drift_mm
        if last.drift_mm > max(rule.max_drift_ratio * before, rule.min_drift_mm):
            return _stop(f"the drift increased: {last.drift_mm:.2f} mm after {before:.2f} mm")
    before = rounds[-2].generalization_mm if len(rounds) > 1 else first_mm
    gain = 1 - last.generalization_mm / before if before > 0 else 0.0
    if rule.early_stopping and not gain >= rule.min_gain:  # also if it is NaN
        return _stop(f"no gain: {last.generalization_mm:.3f} mm after {before:.3f} mm")
    if len(rounds) >= rule.max_rounds:
        return _stop(f"all {rule.max_rounds} rounds done")
    return StoppingVerdict(proceed=True, reason=f"gained {100 * gain:.0f} %: {last.generalization_mm:.3f} mm")


def _stop(reason: str) -> StoppingVerdict:
    return StoppingVerdict(proceed=False, reason=reason)
