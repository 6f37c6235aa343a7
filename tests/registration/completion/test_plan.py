"""What is made follows from what the capture has and from what may be made."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from registration.completion.plan import CompletionPlan, plan_completion
from registration.model.landmarks import LandmarkScheme
from registration.types import Camera, Capture, View

NOTHING = CompletionPlan()


def scheme(name: str) -> LandmarkScheme:
    return LandmarkScheme(name=name, indices=np.zeros((8, 3), int), weights=np.full((8, 3), 1 / 3))


SCHEMES = {name: scheme(name) for name in ("68", "face478")}
POINTS = np.random.default_rng(0).uniform(-0.05, 0.05, (8, 3))


def camera(k: int) -> Camera:
    pose = np.eye(4)
    pose[:3, 3] = [0.1 * k, 0, 1]
    return Camera(
        width_px=100, height_px=100, intrinsics=np.array([[100, 0, 50], [0, 100, 50], [0, 0, 1.0]]), T_cam_world=pose
    )


def landmarks(k: int) -> np.ndarray:
    return np.column_stack([camera(k).project(POINTS)[0], np.ones(8)])


def capture(count: int = 4, **channels: int) -> Capture:
    """A capture whose first views have some channels: name -> number of views."""
    views = []
    for k in range(count):
        view = View(name=f"cam{k}", camera=camera(k), image=Path(f"cam{k}.png"))
        has = {name: Path(name) for name in ("mask", "normals", "segmentation", "depth") if channels.get(name, 0) > k}
        points = {"68": landmarks(k)} if channels.get("landmarks", 0) > k else {}
        views.append(replace(view, **has, landmarks=points))
    classes = ("background", "skin") if channels.get("segmentation") else ()
    return Capture(root=Path(), subject="s", expression="neutral", views=tuple(views), classes=classes)


def made(capture: Capture, **options) -> tuple[str, ...]:
    return plan_completion(capture, SCHEMES, **options).channels


def test_photographs_alone_lack_everything():
    assert made(capture()) == ("landmarks", "masks", "labels", "normals")


def test_a_complete_capture_lacks_nothing():
    assert plan_completion(capture(mask=4, normals=4, segmentation=4, landmarks=4), SCHEMES) == NOTHING
    assert plan_completion(capture(mask=4, normals=4, segmentation=4, landmarks=4), SCHEMES).empty


@pytest.mark.parametrize(
    ("has", "expected"),
    [
        ({"mask": 4}, ("landmarks", "labels", "normals")),
        ({"mask": 1}, ("landmarks", "masks", "labels", "normals")),
        ({"mask": 2}, ("landmarks", "labels", "normals")),
        ({"segmentation": 4}, ("landmarks", "normals")),
        ({"segmentation": 4, "landmarks": 4}, ("normals",)),
        ({"segmentation": 1, "mask": 4, "normals": 4, "landmarks": 4}, ()),
        ({"normals": 4, "mask": 4, "landmarks": 4}, ("landmarks", "labels")),
        ({"depth": 3, "mask": 4}, ("landmarks", "labels")),
    ],
)
def test_what_is_there_is_not_made(has, expected):
    assert made(capture(**has)) == expected


def test_a_scan_stands_in_for_normals_unless_it_is_only_measured():
    scanned = replace(capture(mask=4), scan=Path("scan.ply"))
    assert "normals" not in made(scanned)
    assert "normals" in made(scanned, use_scan=False)


def test_options_leave_steps_out():
    assert made(capture(), stereo=False) == ("landmarks", "masks", "labels")
    assert made(capture(mask=4), detected=None) == ("normals",)
    assert made(capture(mask=4), detected=None, stereo=False) == ()


def test_landmarks_that_the_model_cannot_use_are_not_detected():
    assert made(capture(), detected="other") == ("masks", "labels", "normals")


def test_landmarks_that_contradict_count_as_none():
    wrong = capture(segmentation=4, normals=4, landmarks=4)
    views = [
        replace(view, landmarks={"68": np.column_stack([np.random.default_rng(k).uniform(0, 100, (8, 2)), np.ones(8)])})
        for k, view in enumerate(wrong.views)
    ]
    assert made(replace(wrong, views=tuple(views))) == ("landmarks",)


def test_images_without_the_subjects_colours_and_single_images_are_left_alone():
    assert plan_completion(replace(capture(), photographs=False), SCHEMES) == NOTHING
    assert plan_completion(capture(1), SCHEMES) == NOTHING
