"""The classes that a capture and a model share."""

import numpy as np

from registration.model.regions import CLASSES
from registration.targets.classes import class_map


def test_names_meet_and_strangers_are_left_out():
    capture = ("background", "skin", "neck_other", "hair", "left_eye", "mouth_interior", "glasses")
    found = class_map(capture)
    assert found.names == ("skin", "left_eye", "mouth_interior")
    expected = {"skin": [1, 0, 0], "neck_other": [1, 0, 0], "left_eye": [0, 1, 0], "mouth_interior": [0, 0, 1]}
    for row, name in zip(found.from_capture, capture, strict=True):
        np.testing.assert_array_equal(row, expected.get(name, [0, 0, 0]), err_msg=name)
    np.testing.assert_array_equal(found.excluded, [0, 0, 0, 1, 0, 0, 1])
    np.testing.assert_array_equal(found.neck, [0, 0, 1, 0, 0, 0, 0])


def test_what_the_capture_does_not_tell_apart_is_skin_of_the_model():
    found = class_map(("background", "left_eye", "skin"))
    assert found.from_model.shape == (len(CLASSES), 2)
    np.testing.assert_array_equal(found.from_model.sum(1), 1)
    columns = {name: found.names[row.argmax()] for name, row in zip(CLASSES, found.from_model, strict=True)}
    assert columns.pop("left_eye") == "left_eye"
    assert set(columns.values()) == {"skin"}


def test_a_capture_without_labels():
    found = class_map(())
    assert found.names == ("skin",)
    assert found.from_capture.shape == (0, 1) and found.excluded.shape == found.neck.shape == (0,)
    np.testing.assert_array_equal(found.from_model, np.ones((len(CLASSES), 1)))


def test_the_order_of_labels_is_the_captures():
    capture = ("ears", "skin", "background", "right_eye")
    found = class_map(capture)
    for row, name in zip(found.from_capture, capture, strict=True):
        assert [found.names[k] for k in np.flatnonzero(row)] == ([] if name == "background" else [name])
