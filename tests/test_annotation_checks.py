"""The checks that `tests.annotation_checks` puts on the library refuse what does not match an annotation."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import pytest
from jaxtyping import Float

from registration.capture.triangulation import triangulate_pixels
from registration.types import Camera
from tests.annotation_checks import _checked

Points = Float[np.ndarray, "P 3"]


@dataclass(frozen=True)
class Cloud:
    points: Points
    weights: Float[np.ndarray, "P"]


def mean(points: Points, weights: Float[np.ndarray, "P"]) -> Float[np.ndarray, "3"]:
    return points.T @ weights


def wrong_return(points: Points) -> Float[np.ndarray, "P"]:
    return np.zeros(len(points) + 1)


def in_containers(points: dict[str, list[Points]], other: Points | None = None) -> None:
    pass


def of_length(points: Float[np.ndarray, "{length} 3"], length: int) -> None:
    pass


def each(points: Points) -> Iterator[float]:
    yield from points[:, 0]


def scaled(length_m: float) -> str:
    return length_m if length_m < 0 else str(length_m)  # type: ignore[return-value]


@pytest.mark.parametrize(
    ("item", "right", "wrong"),
    [
        (mean, [(np.zeros((2, 3)), np.zeros(2))], [(np.zeros((2, 3)), np.zeros(4)), (np.zeros((2, 4)), np.zeros(2))]),
        (mean, [], [(np.zeros((2, 3), int), np.zeros(2)), ([[0.0, 0, 0]], np.zeros(1))]),
        (wrong_return, [], [(np.zeros((2, 3)),)]),
        (in_containers, [({"a": [np.zeros((2, 3))]},)], [({"a": [np.zeros((2, 2))]},), ({}, np.zeros(3)), ({1: []},)]),
        (in_containers, [], [({"a": [np.zeros((2, 3))]}, np.zeros((4, 3)))]),
        (of_length, [(np.zeros((2, 3)), 2)], [(np.zeros((2, 3)), 3)]),
        (each, [(np.zeros((2, 3)),)], [(np.zeros((2, 2)),)]),
        (scaled, [(1.5,), (1,)], [("1",), (-1.0,)]),
        (Cloud, [(np.zeros((2, 3)), np.zeros(2))], [(np.zeros((2, 3)), np.zeros(3))]),
    ],
)
def test_what_does_not_match_is_refused(item, right, wrong):
    checked = _checked(item)
    for arguments in right:
        checked(*arguments)
    for arguments in wrong:
        with pytest.raises(TypeError):
            checked(*arguments)


def test_the_library_is_checked():
    with pytest.raises(TypeError):
        triangulate_pixels([], np.zeros((0, 68, 2)))
    with pytest.raises(TypeError):
        Camera(width_px=1.5, height_px=2, intrinsics=np.eye(3), T_cam_world=np.eye(4))  # type: ignore[arg-type]
    with pytest.raises(TypeError):
        Camera(width_px=1, height_px=2, intrinsics=np.eye(2), T_cam_world=np.eye(4))
