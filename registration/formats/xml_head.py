"""XML files recognized by the name of their first element, without reading them."""

import re
from pathlib import Path

from registration.capture.text import listed
from registration.errors import InputError

_FIRST = re.compile(rb"<([A-Za-z_][\w.:-]*)")
_HEAD_BYTES = 4096


def xml_file(path: Path, element: str, pattern: str = "*.xml") -> Path | None:
    """Return the file whose first element has a name: the path itself, or the only such file in the folder `path`.

    Args:
        path: file or folder.
        element: name of the first element, with the prefix that the file uses.
        pattern: of the files in a folder.
    """
    if path.is_dir():
        found = [file for file in sorted(path.glob(pattern)) if first_element(file) == element]
        return found[0] if len(found) == 1 else None
    return path if first_element(path) == element else None


def need_xml_file(path: Path, element: str) -> Path:
    """Return the file to read: as `xml_file`, or else the only XML file in the folder.

    Raises:
        InputError: there is none, or several.
    """
    if (file := xml_file(path, element)) is not None:
        return file
    if not path.is_dir():
        return path
    files = sorted(path.glob("*.xml"))
    if len(files) == 1:
        return files[0]
    raise InputError(
        "The XML file to read is not known",
        where=path,
        expected=f"one XML file with <{element}>",
        got=listed([file.name for file in files], 5) or "none",
        fix="give the path of the file",
    )


def first_element(file: Path) -> str | None:
    """Return the name of the first element of an XML file, None if its first bytes have none."""
    if not file.is_file():
        return None
    try:
        with file.open("rb") as stream:
            head = stream.read(_HEAD_BYTES)
    except OSError:
        return None
    head = re.sub(rb"<!--.*?-->|<\?.*?\?>", b"", head, flags=re.DOTALL).lstrip(b"\xef\xbb\xbf \t\r\n")
    found = _FIRST.match(head)
    return found[1].decode("ascii") if found else None
