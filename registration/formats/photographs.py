"""Photographs that a photogrammetry program names by label, and meshes that lie beside its files."""

import os
import re
from collections.abc import Iterable
from pathlib import Path, PurePosixPath

import numpy as np
from jaxtyping import Float

from registration.capture.text import listed
from registration.errors import InputError
from registration.formats.files import Error, view_names

SUFFIXES = (".png", ".jpg", ".jpeg", ".tif", ".tiff")
_SCANS = ("scan", "mesh", "model")
_SCAN_SUFFIXES = (".ply", ".obj", ".glb")
_OTHERS = ("mask", "masks", "normals", "normal_maps", "depth", "depth_maps", "segmentation", "labels")  # folders
_MASKS = re.compile(r"(.+?)(\.[^.]+)?[._]mask", re.IGNORECASE)  # IMAGE_mask.png of Metashape, IMAGE.JPG.mask.png
MAX_FILES = 200_000  # in a folder and below, that are searched for photographs
_ROTATION = 1e-4  # of entries of R R^T - 1, for a matrix that was written with few digits


class Photographs:
    """The image files in a folder and below, found by path, name or stem.

    Descriptions are moved between machines: of a path in them, the last parts count.
    """

    def __init__(self, folder: Path) -> None:
        """Look through the folder. Raises InputError if it has more than `MAX_FILES` files."""
        self._folder = folder
        self._by_key: dict[str, list[Path]] = {}
        self._masks: dict[str, list[Path]] = {}
        count = 0
        for parent, folders, names in os.walk(folder):
            own = Path(parent).name.lower()
            folders[:] = sorted(name for name in folders if not name.startswith(".") and not name.endswith(".files"))
            count += len(names)
            if count > MAX_FILES:
                raise InputError(
                    "The folder has too many files to look for photographs in",
                    where=folder,
                    expected=f"at most {MAX_FILES} files",
                    got="more",
                    fix="move the description and its photographs into a folder of their own",
                )
            for name in sorted(names):
                path = Path(parent) / name
                if path.suffix.lower() not in SUFFIXES:
                    continue
                named = _MASKS.fullmatch(path.stem)
                if named is not None or own in _OTHERS[:2]:
                    self._masks.setdefault((named[1] if named else path.stem).lower(), []).append(path)
                elif own not in _OTHERS:
                    for key in {name.lower(), path.stem.lower()}:
                        self._by_key.setdefault(key, []).append(path)

    def find(self, label: str, error: Error, entry: str) -> Path:
        """Return the photograph of a label: a path, a name, or a name without its suffix.

        Raises:
            InputError: made by `error(entry, expected, got)`: there is none, or several.
        """
        if (found := self.find_or_none(label, error, entry)) is None:
            raise error(entry, f"a photograph of this name in {self._folder} or below", label or "nothing")
        return found

    def find_or_none(self, label: str, error: Error, entry: str) -> Path | None:
        """Return the photograph of a label as `find`, None if there is none. Raises InputError if there are several."""
        parts = PurePosixPath(label.replace("\\", "/")).parts
        if not parts:
            return None
        found = self._by_key.get(parts[-1].lower(), [])
        for start in range(len(parts)):  # the longest end of the path that any file has decides
            tail = [part.lower() for part in parts[start:-1]]
            close = [path for path in found if [p.lower() for p in path.parts[-1 - len(tail) : -1]] == tail]
            if len(close) == 1:
                return close[0]
            if close:
                raise error(entry, "one photograph of this name", listed(close, 3))
        return None

    def mask(self, image: Path) -> Path | None:
        """Return the mask of a photograph, None if there is none or several.

        It is named as the photograph, in a folder masks, or has `_mask` or `.mask` before its suffix.
        """
        found = self._masks.get(image.stem.lower(), [])
        beside = [path for path in found if image.parent in (path.parent, path.parent.parent)]
        if len(beside) == 1:
            return beside[0]
        return found[0] if len(found) == 1 else None

    def find_mask(self, label: str) -> Path | None:
        """Return the mask at a path relative to the folder, or of that name anywhere below; None if there is none."""
        written = label.replace("\\", "/")
        if (path := self._folder / written).is_file():
            return path
        name = PurePosixPath(written).name
        return next((path for paths in self._masks.values() for path in paths if path.name == name), None)


def unique_views(images: list[Path], root: Path) -> list[str]:
    """Return the names of views of photographs: their stems where these are unique, else their paths below the root.

    Raises:
        InputError: two photographs have one name.
    """
    stems = [image.stem for image in images]
    return stems if len(set(stems)) == len(stems) else view_names(images, root)


def scan_beside(folder: Path) -> Path | None:
    """Return the only mesh in a folder that is named scan, mesh or model; None if there is none, or several."""
    files = [folder / f"{name}{suffix}" for name in _SCANS for suffix in _SCAN_SUFFIXES]
    found = [file for file in files if file.is_file()]
    return found[0] if len(found) == 1 else None


def check_rotation(R: Float[np.ndarray, "3 3"], error: Error, entry: str) -> None:
    """Refuse a matrix that is no rotation: mirrored, scaled or skewed. Raises InputError."""
    if np.abs(R).max() > 2 or np.abs(R @ R.T - np.eye(3)).max() > _ROTATION:
        rows = " / ".join(" ".join(f"{value:.4g}" for value in row) for row in R)
        raise error(entry, "a rotation matrix", f"rows {rows}")
    if np.linalg.det(R) < 0:
        raise error(entry, "a rotation matrix", "a mirroring one, of determinant -1")


def world_to_camera(R: Float[np.ndarray, "3 3"], centre: Float[np.ndarray, "3"]) -> Float[np.ndarray, "4 4"]:
    """Return the pose of a camera with a rotation from world to camera and a centre in the world."""
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R, -R @ centre
    return T


def left_out(names: Iterable[str], why: str) -> tuple[str, ...]:
    """Return the note about cameras that were left out, if any."""
    names = list(names)
    return (f"{len(names)} cameras were left out, {why}: {listed(names, 5)}",) if names else ()
