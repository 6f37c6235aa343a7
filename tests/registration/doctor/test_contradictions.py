import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from registration.errors import InputError
from tests.conftest import needs_shared
from tests.registration.doctor import faulty

pytestmark = needs_shared
EYES, LIPS = {"left_eye": "right_eye", "right_eye": "left_eye"}, {"upper_lip": "lower_lip", "lower_lip": "upper_lip"}


@pytest.mark.parametrize("without", [(), ("segmentation",), ("landmarks",), ("segmentation", "landmarks")])
@pytest.mark.parametrize("views", [(), ("cam07",)])
def test_inverted_masks_are_refused(tmp_path: Path, without: tuple[str, ...], views: tuple[str, ...]) -> None:
    root = faulty.copy(tmp_path)
    for folder in without:
        shutil.rmtree(root / folder)
    faulty.images(root, "masks", lambda mask: 255 - mask, views)
    with pytest.raises(InputError, match="The mask is inverted"):
        faulty.warnings(root)


@pytest.mark.parametrize("pair, what", [(EYES, "left_eye and right_eye"), (LIPS, "upper_lip and lower_lip")])
def test_exchanged_classes_are_refused(tmp_path: Path, pair: dict[str, str], what: str) -> None:
    root = faulty.copy(tmp_path)
    faulty.classes(root, lambda names: [pair.get(name, name) for name in names])
    with pytest.raises(InputError, match=f"The labels {what} are exchanged"):
        faulty.warnings(root)


def test_exchanged_eyes_are_refused_without_landmarks(tmp_path: Path) -> None:
    root = faulty.copy(tmp_path)
    shutil.rmtree(root / "landmarks")
    faulty.classes(root, lambda names: [EYES.get(name, name) for name in names])
    with pytest.raises(InputError, match="left_eye and right_eye are exchanged"):
        faulty.warnings(root)


@pytest.mark.parametrize(
    "change", [lambda names: ["unlabelled", *names[:-1]], lambda names: [*names[1:], "other"]], ids=["later", "earlier"]
)
def test_classes_in_another_order_are_refused(tmp_path: Path, change: Callable[[list[str]], list[str]]) -> None:
    root = faulty.copy(tmp_path)
    faulty.classes(root, change)
    with pytest.raises(InputError, match="in another order, or the background has no name"):
        faulty.warnings(root)


def swapped_eyes(labels: np.ndarray) -> np.ndarray:
    return np.where(labels == 2, 3, np.where(labels == 3, 2, labels)).astype(np.uint8)


WARNED: dict[str, tuple[Callable[[Path], None], str]] = {
    "eyes": (
        lambda root: faulty.images(root, "segmentation", swapped_eyes, ["cam07"]),
        "left_eye and right_eye are exchanged in labels or landmarks: cam07",
    ),
    "white masks": (
        lambda root: faulty.images(root, "masks", lambda mask: np.full_like(mask, 255), ["cam01", "cam07"]),
        "the mask covers the whole image; check that it is a mask: cam01, cam07",
    ),
    "black image": (
        lambda root: faulty.images(root, "images", lambda image: image * 0, ["cam07"]),
        "the image is black where the subject is: cam07",
    ),
    "grey image": (
        lambda root: faulty.images(root, "images", lambda image: image * 0 + 90, ["cam07"]),
        "the image shows nothing, it has one brightness: cam07",
    ),
    "shifted mask": (
        lambda root: faulty.images(root, "masks", lambda mask: np.roll(mask, 150, 1), ["cam07"]),
        "mask and labels show the subject in different places; check which is another image's: cam07",
    ),
    "shifted landmarks": (
        lambda root: faulty.landmarks(root, lambda points: points + [60, 40, 0]),
        "labels and landmarks show the eyes in different places: cam07",
    ),
}


@pytest.mark.parametrize("name", WARNED)
def test_contradictions_are_warned_of(tmp_path: Path, name: str) -> None:
    damage, warning = WARNED[name]
    root = faulty.copy(tmp_path)
    damage(root)
    assert warning in faulty.warnings(root)
