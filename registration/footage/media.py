"""What an input is: one image, a folder of images of one moment, a native capture, or a video."""

from pathlib import Path
from typing import Literal

from registration.calibrate.photographs import SUFFIXES as IMAGE_SUFFIXES
from registration.errors import InputError
from registration.formats.videos import SUFFIXES as VIDEO_SUFFIXES

Kind = Literal["image", "views", "capture", "video"]
SETTINGS, SPARSE = "capture.toml", "sparse"
KINDS = "an image, a folder of images of one moment, a capture folder, or a video"


def recognize(source: Path) -> Kind:
    """Return what an input is, by its name and what lies in a folder.

    Raises:
        InputError: it does not exist, is an empty folder, or a file of another kind.
    """
    suffix = source.suffix.lower()
    if source.is_file():
        if suffix in IMAGE_SUFFIXES:
            return "image"
        if suffix in VIDEO_SUFFIXES:
            return "video"
        raise _unusable(source, f"a file *{suffix or ' without suffix'}", f"convert it: {_suffixes()}")
    if not source.is_dir():
        raise _unusable(source, "no such file or folder", "check the path")
    if (source / SETTINGS).is_file() or (source / SPARSE).is_dir():
        return "capture"
    names = [path.name for path in source.iterdir()]
    if any(Path(name).suffix.lower() in IMAGE_SUFFIXES for name in names):
        return "views"
    videos = [name for name in names if Path(name).suffix.lower() in VIDEO_SUFFIXES]
    if videos:
        raise _unusable(source, f"a folder with {len(videos)} videos", f"give one of them, as {min(videos)}")
    got = f"a folder without images ({len(names)} other names)" if names else "an empty folder"
    raise _unusable(source, got, "give the folder that holds the images")


def _suffixes() -> str:
    return ", ".join((*IMAGE_SUFFIXES, *VIDEO_SUFFIXES))


def _unusable(source: Path, got: str, fix: str) -> InputError:
    return InputError("The input cannot be fitted", where=source, expected=KINDS, got=got, fix=fix)
