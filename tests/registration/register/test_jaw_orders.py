"""Both orders of the right jaw, in the model's file and in the capture's: all 68 points count in each combination."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from registration.fit.initialization import from_landmarks
from registration.inputs import read_inputs
from registration.model.jaw_order import TURNED
from registration.options import RegisterOptions
from tests.fixtures.make_fixtures import HERE as FIXTURES
from tests.registration.register.synthetic import MODEL, Truth


def turn_model(file: Path) -> None:
    rows = np.array(file.read_text().splitlines())
    file.write_text("\n".join(rows[TURNED]) + "\n")


def turn_capture(capture: Path) -> None:
    for file in (capture / "landmarks").iterdir():
        content = json.loads(file.read_text())
        content["68"] = np.array(content["68"])[TURNED].tolist()
        file.write_text(json.dumps(content))


@pytest.mark.parametrize("model_turned", [False, True])
@pytest.mark.parametrize("capture_turned", [False, True])
def test_all_points_count(model_turned: bool, capture_turned: bool, neutral: Truth, tmp_path: Path):
    capture, model = tmp_path / "capture", tmp_path / MODEL.name
    shutil.copytree(neutral.root, capture)
    shutil.copy(MODEL, model)
    shutil.copy(FIXTURES / "head_sparse_68.txt", tmp_path)
    expected = read_inputs(capture, model, RegisterOptions())
    assert expected.notes == ()
    if model_turned:
        turn_model(tmp_path / "head_sparse_68.txt")
    if capture_turned:
        turn_capture(capture)
    inputs = read_inputs(capture, model, RegisterOptions())
    assert [note.partition(":")[0] for note in inputs.notes] == [
        *(["the model's scheme 68"] if model_turned else []),
        *(["the capture's landmarks 68"] if capture_turned else []),
    ]
    np.testing.assert_array_equal(inputs.landmarks["68"], expected.landmarks["68"])
    np.testing.assert_array_equal(inputs.schemes["68"].indices, expected.schemes["68"].indices)
    for view, other in zip(inputs.capture.views, expected.capture.views, strict=True):
        np.testing.assert_array_equal(view.landmarks["68"], other.landmarks["68"])
    assert inputs.input_hash == expected.input_hash  # the result is the same one
    guess = from_landmarks(inputs.data, inputs.schemes["68"], inputs.landmarks["68"], free_scale=True)
    assert guess.landmarks_used["68"][:17].all() and guess.notes == ()
