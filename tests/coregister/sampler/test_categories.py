import numpy as np
import pytest

from coregister.sampler.categories import Blend, Factor, blended, one_hot, parse_blend
from registration.errors import InputError

ACTS = Factor(name="expression", categories=("happy", "sad", "surprise"))
GENDER = Factor(name="gender", categories=("female", "male"))


def test_a_name_alone_is_the_whole_weight():
    assert parse_blend("sad", ACTS) == Blend(weights={"sad": 1.0})


def test_weights_are_scaled_to_the_sum_1_and_it_is_said():
    blend = parse_blend("happy=2, surprise=6", ACTS)
    assert blend.weights == {"happy": 0.25, "surprise": 0.75}
    assert "sum to 8" in blend.remark
    assert parse_blend("happy=0.7,surprise=0.3", ACTS).remark == ""


@pytest.mark.parametrize(
    ("text", "found"),
    [
        ("angry", "happy, sad, surprise"),
        ("happy=0.5,happy=0.5", "each category once"),
        ("happy=0.5,sad", "sad=WEIGHT"),
        ("happy=-1", "a finite number from 0"),
        ("happy=nan", "a finite number from 0"),
        ("happy=x", "a finite number from 0"),
        ("happy=0", "at least one positive weight"),
        ("", "at least one positive weight"),
    ],
)
def test_bad_weights_are_refused(text, found):
    with pytest.raises(InputError) as caught:
        parse_blend(text, ACTS)
    assert found in str(caught.value)


def test_condition_vectors_hold_all_factors():
    rows = one_hot(np.array([[1, 2], [0, 0]]), (GENDER, ACTS))
    assert rows.tolist() == [[0, 1, 0, 0, 1], [1, 0, 1, 0, 0]]
    blends = {"gender": Blend(weights={"male": 1.0}), "expression": Blend(weights={"happy": 0.4, "sad": 0.6})}
    np.testing.assert_allclose(blended(blends, (GENDER, ACTS)), [0, 1, 0.4, 0.6, 0])
