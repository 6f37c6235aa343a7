"""Names of images in a COLMAP model, and what to write instead of one that no file has."""

import unicodedata
from collections.abc import Iterator
from pathlib import Path, PurePosixPath
from urllib.parse import unquote

from registration.errors import InputError

_MAX_NAME_BYTES = 255  # of a file or folder, on common file systems


def image_file(root: Path, name: str) -> PurePosixPath:
    """Return an image's path inside `images/`.

    Args:
        root: the capture folder.
        name: as the COLMAP model has it.

    Raises:
        InputError: the name cannot be used, or there is no such file but one that the name may mean.
    """
    relative = PurePosixPath(name)
    usable = relative.suffix and not relative.is_absolute() and ".." not in relative.parts and "\0" not in name
    if usable and all(len(part.encode()) <= _MAX_NAME_BYTES for part in relative.parts):
        if (root / "images" / relative).exists() or (near := nearest_image(root / "images", name)) is None:
            return relative
        raise InputError(
            "The image is missing",
            where=root / "images" / relative,
            expected="the image that the COLMAP model names, relative to images/",
            got=f"no such file; there is images/{near}",
            fix=f"{_advice(name, near)}: write {near} instead of {name} in the COLMAP model, or rename the file",
        )
    near = None if "\0" in name else nearest_image(root / "images", name)
    raise InputError(
        "An image name cannot be used",
        where=root / "sparse",
        expected="a path inside images/, with a suffix",
        got=name,
        fix="rename the image" if near is None else f"write {near}: names are relative to images/",
    )


def _advice(name: str, near: str) -> str:
    if "\\" in name:
        return "the name holds a backslash, which separates no folders here"
    if PurePosixPath(name).parts[0] == "images":
        return "names do not begin with images/"
    if unicodedata.normalize("NFC", name) == unicodedata.normalize("NFC", near):
        return "its accents are stored in another Unicode form"
    if unquote(name) == near:
        return "its characters are percent-encoded"
    return "names are relative to images/, with all letters as in the file's name"


def nearest_image(images: Path, name: str) -> str | None:
    """A file that the name may mean: fewer folders, other separators, letters or suffix."""
    try:
        files = sorted(str(path.relative_to(images).as_posix()) for path in images.rglob("*") if path.is_file())
    except OSError:
        return None
    plain = unicodedata.normalize("NFC", unquote(name.replace("\\", "/"))).casefold()
    by_key = {key: file for file in reversed(files) for key in _keys(unicodedata.normalize("NFC", file).casefold())}
    parts = PurePosixPath(plain).parts
    tails = ["/".join(parts[start:]) for start in range(len(parts))]
    return next((by_key[key] for tail in tails for key in _keys(tail) if key in by_key), None)


def _keys(file: str) -> Iterator[str]:
    """The name itself, then without its suffix."""
    yield file
    yield file.removesuffix(PurePosixPath(file).suffix) + "."
