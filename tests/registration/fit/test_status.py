"""Status and reason of a registration."""

import pytest
import torch

from registration.fit.problem import FitTrace
from registration.fit.status import judge_fit
from registration.fit.view_weights import ViewErrors

NAN = torch.full((2,), torch.nan)
CALM = ViewErrors(names=("a", "b"), outline_px=NAN, landmark_px=NAN, brightness=torch.zeros(2))
TORN = ViewErrors(names=("a", "b"), outline_px=NAN, landmark_px=torch.tensor([1.0, 40.0]), brightness=torch.zeros(2))
STILL, MOVING = FitTrace(motion_mm=0.01), FitTrace(motion_mm=0.2)
GOOD = {"68": 0.5, "oral": float("nan")}


def test_the_reason_of_convergence_states_the_last_motion() -> None:
    status, reason = judge_fit(STILL, GOOD, ["oral"], TORN)
    assert status == "converged" and "0.010 mm" in reason and "views" not in reason


def test_wrong_skin_landmarks_fail_the_registration() -> None:
    status, reason = judge_fit(STILL, {"68": 3.5, "dense": 8.0, "oral": 20.0}, ["oral"], TORN)
    assert status == "failed" and reason.index("dense are 8.0 px") < reason.index("68 are 3.5 px")
    assert "oral" not in reason and "landmarks off by 40 px in views b" in reason


def test_wrong_teeth_landmarks_are_reported_without_failing() -> None:
    status, reason = judge_fit(STILL, {"68": 0.5, "oral": 5.5}, ["oral"], CALM)
    assert status == "converged"
    assert reason.endswith("; landmarks of scheme oral are 5.5 px off in the median (limit 3.0)")
    assert judge_fit(STILL, {"68": 0.5, "oral": 5.5}, [], CALM)[0] == "failed"


@pytest.mark.parametrize("landmarks, status", [(GOOD, "stopped"), ({"68": 5.0}, "failed")])
def test_a_fit_that_still_moves_has_not_converged(landmarks: dict[str, float], status: str) -> None:
    assert judge_fit(MOVING, landmarks, ["oral"], CALM)[0] == status


def test_the_failure_of_the_fit_is_the_reason() -> None:
    broken = FitTrace(failure="the loss is not finite")
    assert judge_fit(broken, {"68": 50.0}, [], TORN) == ("failed", "the loss is not finite")


def test_vague_landmarks_may_be_as_far_off_as_their_spread_explains() -> None:
    status, reason = judge_fit(STILL, {"face478": 4.2}, [], CALM, {"face478": 1.6})
    assert status == "converged" and "4.2 px" in reason and "1.6" in reason
    status, reason = judge_fit(STILL, {"face478": 9.0}, [], CALM, {"face478": 3.4})
    assert status == "failed" and "9.0 px" in reason and "3.4" in reason
    assert judge_fit(STILL, {"face478": 1.0}, [], CALM, {"face478": 8.0})[0] == "converged"
