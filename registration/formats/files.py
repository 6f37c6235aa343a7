"""Image files that other programs' descriptions name: where they are, their size, and names of views from theirs."""

import os
from collections import Counter
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

from PIL import Image

from registration.capture.headers import read_header
from registration.errors import InputError
from registration.storage.reading import open_file, path_defect

_IMAGE_FOLDERS = ("images", "image", "rgb", "input", "undistorted")
_ORIENTATION_TAG = 0x0112
TURNED = (5, 6, 7, 8)  # orientations that exchange width and height
Error = Callable[[str, object, object], InputError]  # entry, expected, got


def find_image(folder: Path, name: str, error: Error, entry: str, *, suffixes: Sequence[str] = ()) -> Path:
    """Return the file that a description names.

    Args:
        folder: that the name is relative to; an absolute name stands for itself, and where it does not exist, its last
            parts are looked for in the folder: descriptions are moved between machines.
        name: as in the description; backslashes separate folders where no such file exists.
        error: makes the error.
        entry: of the description, for the message.
        suffixes: tried after the name as it is, for descriptions that leave them out.

    Raises:
        InputError: there is no such file.
    """
    if not name or (defect := path_defect(name)):
        raise error(entry, "the path of a file", defect if name else "nothing")
    for written in dict.fromkeys((name, name.replace("\\", "/"))):
        for suffix in ("", *suffixes):
            path = folder / (written + suffix)
            if path.is_file():
                return path
        parts = Path(written).parts
        if Path(written).is_absolute() or "\\" in name:
            for start in range(1, len(parts)):
                if (path := folder.joinpath(*parts[start:])).is_file():
                    return path
    listed = f" or with {', '.join(suffixes)}" if suffixes else ""
    raise error(entry, f"an existing file, relative to {folder}{listed}", name)


def stored_size(image: Path) -> tuple[int, int]:
    """Return width and height (px) of an image file as its pixels are stored. Raises InputError if it is none."""
    header = read_header(image, "image")
    return header.width_px, header.height_px


def orientation(image: Path) -> int:
    """Return the EXIF orientation of an image file, 1 if it has none: 1 to 8, see `TURNED`. Raises InputError."""
    refuse = partial(InputError, "The image is not a readable image", where=image, fix="write it again")
    with open_file(image, refuse) as stream:
        try:
            with Image.open(stream) as opened:
                value = opened.getexif().get(_ORIENTATION_TAG, 1)
        except Exception:  # metadata are optional, and damaged ones make Pillow raise nearly anything
            return 1
    return value if value in range(1, 9) else 1


def view_names(images: Sequence[Path], root: Path) -> list[str]:
    """Return names of views: the files' paths below the root, or below all files' common folder, without suffixes.

    A folder such as `images` that all are in is left out.

    Raises:
        InputError: two of them are equal.
    """
    files = [Path(os.path.abspath(image)) for image in images]
    base = Path(os.path.abspath(root))
    if not all(file.is_relative_to(base) for file in files):
        base = Path(os.path.commonpath([file.parent for file in files]))
    relative = [file.relative_to(base) for file in files]
    while all(len(path.parts) > 1 and path.parts[0].lower() in _IMAGE_FOLDERS for path in relative):
        if len({path.parts[0] for path in relative}) > 1:
            break
        relative = [path.relative_to(path.parts[0]) for path in relative]
    names = [path.with_suffix("").as_posix() for path in relative]
    repeated = [name for name, count in Counter(names).items() if count > 1]
    if repeated:
        raise InputError(
            "Two images have one name",
            where=root,
            expected="names that stay unique without their suffixes: they name the views",
            got=repeated[0],
            fix="remove one of them from the description, or rename it",
        )
    return names
