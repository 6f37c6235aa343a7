import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from registration.doctor.landmark_checks import MIRRORED_68
from registration.errors import InputError
from tests.conftest import needs_shared
from tests.registration.doctor import faulty
from tests.registration.doctor.faulty import HEIGHT_PX, WIDTH_PX

pytestmark = needs_shared
SIZE = np.array([WIDTH_PX, HEIGHT_PX, 1])
Change = Callable[[np.ndarray], np.ndarray]


def mirrored(points: np.ndarray) -> np.ndarray:
    return np.array([WIDTH_PX, 0, 0]) + points * [-1, 1, 1]


REFUSED: dict[str, tuple[Change, str]] = {
    "fractions": (lambda p: p / SIZE, "look normalized"),
    "fractions from -1": (lambda p: p / SIZE * [2, 2, 1] - [1, 1, 0], "look normalized"),
    "percent of the size": (lambda p: p / SIZE * [100, 100, 1], "100 x 100"),
    "half the resolution": (lambda p: p * [0.5, 0.5, 1], "0.5 times the size"),
    "twice the resolution": (lambda p: p * [2, 2, 1], "2 times the size"),
    "squares of 512": (lambda p: p / SIZE * [512, 512, 1], "512 x 512"),
    "longer side of 1024": (lambda p: p * [1024 / HEIGHT_PX, 1024 / HEIGHT_PX, 1], "longer side 1024"),
    "exchanged axes": (lambda p: p[:, [1, 0, 2]], "x and y exchanged"),
    "y up": (lambda p: np.array([0, HEIGHT_PX, 0]) + p * [1, -1, 1], "y from the lower edge"),
    "mirrored": (mirrored, "mirrored images"),
    "mirrored and named so": (lambda p: mirrored(p)[MIRRORED_68], "mirrored images"),
    "left for right": (lambda p: p[MIRRORED_68], "Left and right of the landmarks are exchanged"),
    "confidence in percent": (lambda p: p * [1, 1, 100], "confidences are not between 0 and 1"),
    "flags of COCO": (lambda p: np.column_stack([p[:, :2], 1 + (p[:, 2] > 0.5)]), "confidences are not between 0"),
    "no confidence": (lambda p: p * [1, 1, 0], "No landmark is used"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_landmarks_in_other_units_or_orders_are_refused_with_the_reason(tmp_path: Path, name: str) -> None:
    change, what = REFUSED[name]
    root = faulty.copy(tmp_path)
    faulty.landmarks(root, change)
    with pytest.raises(InputError) as caught:
        faulty.warnings(root)
    assert what in caught.value.what and caught.value.where == str(root / "landmarks")


WARNED: dict[str, tuple[Change, str]] = {
    "left for right": (lambda p: p[MIRRORED_68], "cam07: its landmarks fit the other views if they are with left"),
    "half the resolution": (
        lambda p: p * [0.5, 0.5, 1],
        "cam07: its landmarks fit the other views if they are in",
    ),
    "exchanged axes": (lambda p: p[:, [1, 0, 2]], "cam07: its landmarks fit the other views if they are with x and y"),
    "elsewhere": (lambda p: p + [60, 30, 0], "cam07: most of its landmarks contradict the other views"),
}


@pytest.mark.parametrize("name", WARNED)
def test_one_view_is_warned_of(tmp_path: Path, name: str) -> None:
    change, warning = WARNED[name]
    root = faulty.copy(tmp_path)
    faulty.landmarks(root, change, ["cam07"])
    assert warning in faulty.warnings(root)


def test_scheme_68_by_another_name_is_warned_of(tmp_path: Path) -> None:
    root = faulty.copy(tmp_path)
    for path in (root / "landmarks").iterdir():
        path.write_text(json.dumps({"ibug": json.loads(path.read_text())["68"]}))
    assert "the landmarks of scheme ibug are 68 points" in faulty.warnings(root)


def test_mirroring_twice_is_the_identity() -> None:
    np.testing.assert_array_equal(MIRRORED_68[MIRRORED_68], np.arange(68))
