"""The classes that a capture and a model share."""

import numpy as np

from registration.model.regions import CLASSES
from registration.targets.classes import class_map


def test_shared_classes_are_matched_and_others_excluded():
    capture = ("background", "skin", "neck_other", "hair", "left_eye", "mouth_interior", "glasses")
    classes = class_map(capture)
    assert classes.names == ("skin", "left_eye", "mouth_interior")
    expected = {"skin": [1, 0, 0], "neck_other": [1, 0, 0], "left_eye": [0, 1, 0], "mouth_interior": [0, 0, 1]}
    for row, name in zip(classes.from_capture, capture, strict=True):
        np.testing.assert_array_equal(row, expected.get(name, [0, 0, 0]), err_msg=name)
    np.testing.assert_array_equal(classes.excluded, [0, 0, 0, 1, 0, 0, 1])
    np.testing.assert_array_equal(classes.neck, [0, 0, 1, 0, 0, 0, 0])


def test_classes_that_the_capture_lacks_are_skin_of_the_model():
    classes = class_map(("background", "left_eye", "skin"))
    assert classes.from_model.shape == (len(CLASSES), 2)
    np.testing.assert_array_equal(classes.from_model.sum(1), 1)
    columns = {name: classes.names[row.argmax()] for name, row in zip(CLASSES, classes.from_model, strict=True)}
    assert columns.pop("left_eye") == "left_eye"
    assert set(columns.values()) == {"skin"}


def test_a_capture_without_labels():
    classes = class_map(())
    assert classes.names == ("skin",)
    assert classes.from_capture.shape == (0, 1) and classes.excluded.shape == classes.neck.shape == (0,)
    np.testing.assert_array_equal(classes.from_model, np.ones((len(CLASSES), 1)))


def test_labels_are_ordered_as_in_the_capture():
    capture = ("ears", "skin", "background", "right_eye")
    classes = class_map(capture)
    for row, name in zip(classes.from_capture, capture, strict=True):
        assert [classes.names[k] for k in np.flatnonzero(row)] == ([] if name == "background" else [name])
