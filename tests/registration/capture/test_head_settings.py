"""A capture that says that its images show nothing, and where the head is."""

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from registration.capture.native import read_capture
from registration.capture.native_writer import CaptureDescription, write_capture
from registration.doctor.validation import validate_capture
from registration.errors import InputError
from registration.targets.classes import class_map
from registration.targets.pyramid import build_pyramid
from registration.types import HeadPose
from tests.registration.capture.small import CLASSES, camera, make, synthetic_view

POSE = HeadPose(
    rotation=Rotation.from_euler("xyz", (0.3, -2, 1)).as_matrix(), translation=np.array([0.1, 2, -3]), scale=1.07
)


def test_pose_photographs_and_tables_of_tags_are_read_as_written(tmp_path: Path) -> None:
    tags = {"scan_hygiene": {"unit": "mm", "holes": 3, "extent_mm": [1.5, 2.0], "inside_out": False}}
    description = CaptureDescription(
        subject="a", expression="b", classes=CLASSES, tags=tags, photographs=False, head=POSE
    )
    views = [synthetic_view(f"cam{k}", camera(0.4 * k)) for k in range(2)]
    capture = read_capture(write_capture(tmp_path / "capture", views, description))
    assert not capture.photographs and capture.head is not None and capture.tags == tags
    np.testing.assert_array_equal(capture.head.rotation, POSE.rotation)
    np.testing.assert_array_equal(capture.head.translation, POSE.translation)
    assert capture.head.scale == POSE.scale
    plain = read_capture(make(tmp_path / "plain"))
    assert plain.photographs and plain.head is None
    images = {
        one.root: next(c for c in validate_capture(one).channels if c.name == "images") for one in (capture, plain)
    }
    assert not images[capture.root].counted and images[plain.root].counted
    for one in (capture, plain):
        targets = build_pyramid(one, class_map(one.classes), finest_head_px=100, levels=1)[0]
        assert bool(targets.rgb_weight.any()) == one.photographs
        assert targets.normal_weight.any()


@pytest.mark.parametrize(
    "line",
    [
        "photographs = 0",
        "head = 3",
        "[head]\nrotation = [1, 0, 0, 0, 1, 0, 0, 0, 1]",
        "[head]\nrotation = [1, 0, 0, 0, 1, 0, 0, 0, 2]\ntranslation = [0, 0, 0]",
        "[head]\nrotation = [1, 0, 0, 0, 1, 0, 0, 0, -1]\ntranslation = [0, 0, 0]",
        "[head]\nrotation = [1, 0, 0, 0, 1, 0, 0, 0, 1]\ntranslation = [0, 0, true]",
        "[head]\nrotation = [1, 0, 0, 0, 1, 0, 0, 0, 1]\ntranslation = [0, 0, 0]\nscale = -1",
        "[head]\nrotation = [1, 0, 0, 0, 1, 0, 0, 0, 1]\ntranslation = [0, 0, 0]\nsize = 1",
    ],
)
def test_what_is_no_pose_is_refused(tmp_path: Path, line: str) -> None:
    root = make(tmp_path / "capture")
    settings = root / "capture.toml"
    settings.write_text(line + "\n" + settings.read_text() if "[" not in line else settings.read_text() + "\n" + line)
    with pytest.raises(InputError, match=r"truth value|\[head\]"):
        read_capture(root)
