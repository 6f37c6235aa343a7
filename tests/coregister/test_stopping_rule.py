import pytest

from coregister.stopping_rule import RoundMetrics, StoppingRule, apply_stopping_rule


def _round(mm: float, drift: float = 1.0, registered: int = 40, failed: int = 0) -> RoundMetrics:
    return RoundMetrics(generalization_mm=mm, drift_mm=drift, registered=registered, failed=failed)


@pytest.mark.parametrize(
    "rounds, proceed, word",
    [
        ([_round(0.8)], True, "gained 20 %"),
        ([_round(0.8), _round(0.7, drift=0.5)], True, "gained 13 %"),
        ([_round(0.99)], False, "no gain"),
        ([_round(1.2)], False, "no gain"),
        ([_round(float("nan"))], False, "no gain"),
        ([_round(0.8), _round(0.79, drift=0.5)], False, "no gain"),
        ([_round(0.8, drift=1), _round(0.5, drift=1.6)], False, "drift increased"),
        ([_round(0.8, drift=0.01), _round(0.5, drift=0.09)], True, "gained"),
        ([_round(0.5, registered=30, failed=10)], False, "too many failures: 25 %"),
        ([_round(0.5, registered=0, failed=3)], False, "too many failures: 100 %"),
        ([_round(0.8), _round(0.6, drift=0.5), _round(0.4, drift=0.2)], False, "all 3 rounds"),
    ],
)
def test_verdicts_and_their_reasons(rounds: list[RoundMetrics], proceed: bool, word: str):
    verdict = apply_stopping_rule(1.0, rounds)
    assert verdict.proceed is proceed and word in verdict.reason


def test_failures_come_before_drift_and_drift_before_gain():
    bad = [_round(0.8, drift=1), _round(0.9, drift=5, registered=1, failed=9)]
    assert "failures" in apply_stopping_rule(1.0, bad).reason
    assert "drift" in apply_stopping_rule(1.0, bad, StoppingRule(max_failure_rate=0.95)).reason
    assert "gain" in apply_stopping_rule(1.0, bad, StoppingRule(max_failure_rate=0.95, max_drift_ratio=10)).reason


def test_without_early_stopping_only_failures_stop():
    rule = StoppingRule(max_rounds=2, early_stopping=False)
    worse = [_round(1.2, drift=1), _round(1.3, drift=5)]
    assert apply_stopping_rule(1.0, worse[:1], rule).proceed
    assert "all 2 rounds done" in apply_stopping_rule(1.0, worse, rule).reason
    assert "failures" in apply_stopping_rule(1.0, [_round(1.2, registered=1, failed=9)], rule).reason


def test_the_rule_needs_a_round():
    with pytest.raises(ValueError):
        apply_stopping_rule(1.0, [])
