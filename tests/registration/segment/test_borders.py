"""Borders inside the face, on drawn pictures: lids and lips of given shape."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from registration.detect import face478_points as points
from registration.segment.borders import Face, aperture, closed, drawn, refine_borders
from registration.segment.fitted import INDEX

PX_PER_M = 2000.0
SHAPE = (60, 90)
CENTRE, HALF_WIDTH = np.array([45.0, 30.0]), 24.0


def rims(half_height: float, count: int = 9, turn: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """The upper and the lower rim of a lens-shaped opening."""
    x = np.linspace(-1, 1, count)
    curve = np.stack([x * HALF_WIDTH, (1 - x**2) * half_height], 1)
    rotation = np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])
    return CENTRE + curve * [1, -1] @ rotation, CENTRE + curve @ rotation


def landmarks(half_height: float, confidence: float = 0.9) -> np.ndarray:
    """All points, of which those of the left eye's lids count."""
    result = np.zeros((points.COUNT, 3))
    for indices, rim in zip((points.LEFT_LID_UPPER, points.LEFT_LID_LOWER), rims(half_height), strict=True):
        result[list(indices)] = np.column_stack([rim, np.full(len(rim), confidence)])
    return result


def opening(half_height: float) -> np.ndarray:
    above, below = rims(half_height, 65)
    return drawn(np.concatenate([above, below[::-1]]), SHAPE)


def face(half_height: float, marks: np.ndarray | None, noise: float = 2.0) -> Face:
    """A white eye with a dark iris in skin."""
    eye = opening(half_height)
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]] + 0.5
    iris = (x - CENTRE[0]) ** 2 + (y - CENTRE[1]) ** 2 < 8**2
    image = np.where(eye[..., None], np.where(iris[..., None], (60, 45, 35), (225, 220, 215)), (170, 125, 100))
    image = image + np.random.default_rng(4).normal(0, noise, image.shape)
    return Face(
        image=image.clip(0, 255).astype(np.uint8),
        landmarks=marks,
        px_per_m=PX_PER_M,
        error_m=1.5e-3,
        closed=closed([marks]),
    )


def model_labels(half_height: float) -> np.ndarray:
    return np.where(opening(half_height), INDEX["left_eye"], INDEX["skin"])


def overlap(found: np.ndarray, true: np.ndarray) -> float:
    return (found & true).sum() / max((found | true).sum(), 1)


@given(st.floats(0.5, 12), st.floats(-1, 1))
def test_the_aperture_does_not_depend_on_the_heads_turn(half_height, turn):
    assert np.isclose(aperture(*rims(half_height, turn=turn)), half_height / HALF_WIDTH, rtol=1e-6)


@given(st.floats(2, 12))
def test_a_drawn_opening_has_its_area(half_height):
    area = 2 * half_height * 2 * HALF_WIDTH * 2 / 3  # of two parabolas
    assert abs(opening(half_height).sum() - area) < 0.06 * area + 12


def test_an_eye_that_the_model_opens_too_little_is_found():
    labels = refine_borders(face(9, landmarks(8.2)), model_labels(6))
    assert overlap(labels == INDEX["left_eye"], opening(9)) > 0.9


def test_an_eye_without_landmarks_moves_to_the_images_edges():
    labels = refine_borders(face(9, None), model_labels(7.5))
    assert overlap(labels == INDEX["left_eye"], opening(9)) > 0.85


def test_a_closed_eye_has_no_label_although_the_model_is_open():
    labels = refine_borders(face(0.5, landmarks(0.8)), model_labels(6))
    assert (labels == INDEX["skin"]).all()


def test_unsure_landmarks_do_not_close_an_eye():
    assert closed([landmarks(0.8, confidence=0.3)]) == frozenset()
    assert closed([landmarks(0.8), None]) == {"left_eye"}
    assert closed([landmarks(0.8), landmarks(8), landmarks(9)]) == frozenset()


def test_a_border_that_cannot_be_seen_has_no_label():
    even = face(9, None)
    even.image[:] = 128
    labels = refine_borders(even, model_labels(7.5))
    above, below = rims(7.5)
    at_rim = labels[
        np.floor(np.concatenate([above, below])[:, 1]).astype(int), np.floor(above[[*range(9)] * 2, 0]).astype(int)
    ]
    assert (at_rim == INDEX["unlabelled"]).mean() > 0.7
