"""After a round: go on, or stop and say why. A pure function of the rounds so far."""

from collections.abc import Sequence
from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True)
class Round:
    """What one round of registering, building and evaluating came to."""

    generalization_mm: float  # of the model that the round built, on held-out subjects
    drift_mm: float  # rms motion of the stable skin between the template it was given and the one that it built
    registered: int  # registrations that went into the model
    failed: int  # that did not: failed, or rejected as spoiled


@dataclass(frozen=True, kw_only=True)
class Rule:
    """When it is enough."""

    rounds: int = 3  # at most
    gain: float = 0.02  # least share of the error that a round must take away
    drift: float = 1.5  # a round's drift over the one before, from which on it is no longer settling,
    drift_mm: float = 0.1  # if it is more than this
    failures: float = 0.2  # share of the registrations
    early: bool = True  # whether want of gain, or drift that grew, ends it before all rounds are done


@dataclass(frozen=True, kw_only=True)
class Verdict:
    go_on: bool
    reason: str


def decide(first_mm: float, rounds: Sequence[Round], rule: Rule | None = None) -> Verdict:
    """Whether another round is worth it; `first_mm` is the generalization of the model that the first one was given.

    What is wrong counts before what is finished: too many failures, then drift that grew, then no gain, then the number
    of rounds. Raises ValueError without a round.
    """
    rule = rule or Rule()
    if not rounds:
        raise ValueError("there is no round to decide on")
    last = rounds[-1]
    share = last.failed / max(last.failed + last.registered, 1)
    if share > rule.failures:
        return Verdict(go_on=False, reason=f"too many failures: {100 * share:.0f} % of the registrations")
    if rule.early and len(rounds) > 1:
        before = rounds[-2].drift_mm
        if last.drift_mm > max(rule.drift * before, rule.drift_mm):
            return Verdict(go_on=False, reason=f"drift grew: {last.drift_mm:.2f} mm after {before:.2f} mm")
    before = rounds[-2].generalization_mm if len(rounds) > 1 else first_mm
    gain = 1 - last.generalization_mm / before if before > 0 else 0.0
    if rule.early and not gain >= rule.gain:  # nor NaN
        return Verdict(go_on=False, reason=f"no gain: {last.generalization_mm:.3f} mm after {before:.3f} mm")
    if len(rounds) >= rule.rounds:
        return Verdict(go_on=False, reason=f"all {rule.rounds} rounds done")
    return Verdict(go_on=True, reason=f"gained {100 * gain:.0f} %: {last.generalization_mm:.3f} mm")
