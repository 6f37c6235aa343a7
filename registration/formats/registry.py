"""The layouts that can be read, and which of them a folder has."""

from collections.abc import Sequence
from pathlib import Path

from registration.errors import InputError
from registration.formats import (
    bare_folder,
    blocks_exchange,
    colmap_project,
    facescape,
    metashape_psx,
    metashape_xml,
    multiface,
    native_source,
    nerfstudio,
    nersemble,
    opencv_yaml,
    reality_csv,
    reality_xmp,
    vhap,
)
from registration.formats.source import Format, ReadOptions, SourceCapture

FORMATS: tuple[Format, ...] = (
    native_source.FORMAT,
    colmap_project.FORMAT,
    nerfstudio.FORMAT,
    opencv_yaml.FORMAT,
    bare_folder.FORMAT,
    blocks_exchange.FORMAT,
    facescape.FORMAT,
    metashape_xml.FORMAT,
    metashape_psx.FORMAT,
    multiface.FORMAT,
    nersemble.FORMAT,
    reality_csv.FORMAT,
    reality_xmp.FORMAT,
    vhap.FORMAT,
)


def find_format(name: str) -> Format:
    """Return the format of a name, in any case. Raises InputError, with all names, if there is none."""
    for known in FORMATS:
        if known.name == name.strip().lower():
            return known
    raise InputError(
        "There is no such format",
        where="--format",
        expected=", ".join(known.name for known in FORMATS),
        got=name,
        fix="name one of these; docs/formats.md describes them",
    )


def detect_format(path: Path) -> Format:
    """Return the format of a folder or file by the names and first bytes of its files.

    Raises:
        InputError: it is missing, of no known format, or of several.
    """
    if not path.exists():
        raise _undetected(
            "The capture to import is missing", path, "a file or folder", "no such path", "check the path"
        )
    found = [known for known in FORMATS if known.detect(path)]
    if len(found) == 1:
        return found[0]
    if found:
        names = ", ".join(f"{known.name} ({known.files})" for known in found)
        fix = f"say which one to read with --format {found[0].name}, or the other name"
        raise _undetected("The capture has the files of several formats", path, "those of one", names, fix)
    raise _undetected(
        "The format of the capture is not known",
        path,
        "; ".join(f"{known.name}: {known.files}" for known in FORMATS),
        _listing(path),
        "check the path, or name the format with --format",
    )


def read_source(path: Path, options: ReadOptions, *, name: str | None = None) -> SourceCapture:
    """Read a capture in another program's layout.

    Args:
        path: its folder or file.
        options: what the files do not say.
        name: of the format; None: it is detected.

    Raises:
        InputError: the format is unknown, an option has no meaning in it, or the capture cannot be read.
    """
    known = detect_format(path) if name is None else find_format(name)
    if not path.exists():
        raise _undetected("The capture to import is missing", path, known.files, "no such path", "check the path")
    if options.frame is not None and not known.sequences:
        raise InputError(
            "The format has no frames to choose from",
            where="--frame",
            expected=f"no frame number for {known.title}",
            got=options.frame,
            fix="leave the option out",
        )
    return known.read(path, options)


def _undetected(what: str, path: Path, expected: str, got: str, fix: str) -> InputError:
    return InputError(what, where=path, expected=expected, got=got, fix=fix)


def _listing(path: Path) -> str:
    if not path.is_dir():
        return f"the file {path.name}"
    names: Sequence[str] = sorted(item.name + "/" * item.is_dir() for item in path.iterdir())
    return ", ".join(names[:12]) + (f" and {len(names) - 12} more" if len(names) > 12 else "") or "an empty folder"
