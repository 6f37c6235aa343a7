"""Faults of whole captures, made in copies of a shared one, and what the checks say about them."""

import json
import shutil
from collections.abc import Callable, Collection
from pathlib import Path

import cv2
import numpy as np

from registration.capture import native
from registration.doctor.validation import validate_capture
from tests.conftest import SHARED

SOURCE = SHARED / "data" / "captures" / "ict_pop_00" / "neutral"  # 7 views of 480 x 720 px
WIDTH_PX, HEIGHT_PX = 480, 720
Change = Callable[[np.ndarray], np.ndarray]


def copy(tmp_path: Path) -> Path:
    """A copy of the shared capture that may be damaged."""
    return shutil.copytree(SOURCE, tmp_path / "capture", copy_function=shutil.copyfile)


def warnings(root: Path) -> str:
    """The warnings of a capture's checks, one a line. Raises InputError."""
    ledger = validate_capture(native.read_capture(root))
    return "\n".join([*ledger.warnings, *ledger.unread])


def images(root: Path, folder: str, change: Change, views: Collection[str] = ()) -> None:
    """Change the images of a folder as stored, of all views or some."""
    for path in sorted((root / folder).glob("*.png")):
        if not views or path.stem in views:
            cv2.imwrite(str(path), change(cv2.imread(str(path), cv2.IMREAD_UNCHANGED)))


def normals(root: Path, change: Change, views: Collection[str] = ()) -> None:
    """Change the vectors of normal maps."""

    def encoded(pixels: np.ndarray) -> np.ndarray:
        vectors = change(pixels[..., ::-1] * (2 / 65535) - 1)
        result = np.round((vectors + 1) * (65535 / 2)).clip(0, 65535).astype(np.uint16)[..., ::-1].copy()
        result[(pixels == 0).all(-1)] = 0
        return result

    images(root, "normals", encoded, views)


def landmarks(root: Path, change: Change, views: Collection[str] = ()) -> None:
    """Change the landmarks of scheme 68."""
    for path in sorted((root / "landmarks").glob("*.json")):
        if not views or path.stem in views:
            points = np.array(json.loads(path.read_text())["68"])
            path.write_text(json.dumps({"68": change(points).tolist()}))


def classes(root: Path, change: Callable[[list[str]], list[str]]) -> None:
    """Change the names of the label classes."""
    path = root / "capture.toml"
    head, names = path.read_text().split("classes =")
    path.write_text(f"{head}classes = {json.dumps(change(json.loads(names)))}\n")


def exchange(root: Path, folder: str, first: str, second: str) -> None:
    """Exchange the files of two views in a folder."""
    (a,), (b,) = ((root / folder).glob(f"{name}.*") for name in (first, second))
    content = a.read_bytes()
    a.write_bytes(b.read_bytes())
    b.write_bytes(content)


FOLDERS = ("images", "masks", "normals", "segmentation", "landmarks")
