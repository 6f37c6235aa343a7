import pytest

from coregister.stopping_rule import Round, Rule, decide


def _round(mm: float, drift: float = 1.0, registered: int = 40, failed: int = 0) -> Round:
    return Round(generalization_mm=mm, drift_mm=drift, registered=registered, failed=failed)


@pytest.mark.parametrize(
    "rounds, go_on, word",
    [
        ([_round(0.8)], True, "gained 20 %"),
        ([_round(0.8), _round(0.7, drift=0.5)], True, "gained 13 %"),
        ([_round(0.99)], False, "no gain"),
        ([_round(1.2)], False, "no gain"),
        ([_round(float("nan"))], False, "no gain"),
        ([_round(0.8), _round(0.79, drift=0.5)], False, "no gain"),
        ([_round(0.8, drift=1), _round(0.5, drift=1.6)], False, "drift grew"),
        ([_round(0.8, drift=0.01), _round(0.5, drift=0.09)], True, "gained"),
        ([_round(0.5, registered=30, failed=10)], False, "too many failures: 25 %"),
        ([_round(0.5, registered=0, failed=3)], False, "too many failures: 100 %"),
        ([_round(0.8), _round(0.6, drift=0.5), _round(0.4, drift=0.2)], False, "all 3 rounds"),
    ],
)
def test_decisions_and_their_reasons(rounds: list[Round], go_on: bool, word: str):
    verdict = decide(1.0, rounds)
    assert verdict.go_on is go_on and word in verdict.reason


def test_what_is_wrong_comes_before_what_is_finished():
    bad = [_round(0.8, drift=1), _round(0.9, drift=5, registered=1, failed=9)]
    assert "failures" in decide(1.0, bad).reason
    assert "drift" in decide(1.0, bad, Rule(failures=0.95)).reason
    assert "gain" in decide(1.0, bad, Rule(failures=0.95, drift=10)).reason


def test_all_rounds_are_done_if_asked_for_unless_too_many_fail():
    rule = Rule(rounds=2, early=False)
    worse = [_round(1.2, drift=1), _round(1.3, drift=5)]
    assert decide(1.0, worse[:1], rule).go_on
    assert "all 2 rounds done" in decide(1.0, worse, rule).reason
    assert "failures" in decide(1.0, [_round(1.2, registered=1, failed=9)], rule).reason


def test_there_is_nothing_to_decide_before_the_first_round():
    with pytest.raises(ValueError):
        decide(1.0, [])
