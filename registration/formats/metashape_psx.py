"""Projects of Agisoft Metashape: `NAME.psx` with `NAME.files`, whose zip files hold XML.

`NAME.psx` names `project.zip`, that names each chunk's `chunk.zip` (sensors, cameras, world), that names each frame's
`frame.zip`: the paths of the photographs, relative to it as if it were a folder. Nothing else is read.
"""

import os
import zipfile
import zlib
from functools import partial
from pathlib import Path, PurePosixPath

from registration.errors import InputError
from registration.formats.files import Error
from registration.formats.metashape_chunk import only_chunk, read_chunk
from registration.formats.photographs import Photographs
from registration.formats.source import Format, ReadOptions, SourceCapture
from registration.formats.xml_files import FIX, Element, parse_xml, read_xml
from registration.storage.reading import MAX_TEXT_BYTES, open_file

_DOCUMENT = "doc.xml"
_COMPRESSIONS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)


def _detect(path: Path) -> bool:
    return _project(path) is not None


def _project(path: Path) -> Path | None:
    """The project file: the path itself, or the only one in a folder."""
    found = sorted(path.glob("*.psx")) if path.is_dir() else [path] if path.suffix.lower() == ".psx" else []
    return found[0] if len(found) == 1 and found[0].is_file() else None


def read(path: Path, options: ReadOptions) -> SourceCapture:
    """Read a project; photographs are looked for where it says, then in its folder and below.

    Raises:
        InputError: a file is missing or malformed, the project has several enabled chunks, or several frames and
            `options.frame` names none of them, or as `registration.formats.metashape_chunk.read_chunk`.
    """
    file = _project(path) or path
    top = read_xml(file)
    written = top.attribute("path").replace("{projectname}", file.stem)
    archive = _below(file.parent, written, top)
    project = _document(archive)
    entries = project.need("chunks").all("chunk")
    zips = [_below(archive.parent, entry.attribute("path"), entry) for entry in entries]
    documents = [_document(zip_file) for zip_file in zips]
    chunk = only_chunk(documents, project.error("an enabled chunk", "none"))
    chunk_zip = zips[documents.index(chunk)]
    frame_zip = _frame(chunk, chunk_zip, options.frame)
    frame = _document(frame_zip)
    paths = {camera.attribute("camera_id"): _photo(camera) for camera in frame.need("cameras").all("camera")}
    resolved = {number: _resolve(frame_zip, written) for number, written in paths.items()}
    result = read_chunk(chunk, _ProjectPhotographs(file.parent), file.parent, resolved)
    notes = (*result.notes, "the project's masks and meshes were not read: export them beside the cameras' XML")
    return SourceCapture(
        format=FORMAT.name,
        root=file.parent,
        subject=options.subject or file.stem,
        expression=options.expression or "neutral",
        views=result.views,
        unit_m=result.unit_m,
        notes=notes,
    )


class _ProjectPhotographs(Photographs):
    """Photographs by the paths of a project, which may lie outside its folder."""

    def find_or_none(self, label: str, error: Error, entry: str) -> Path | None:
        """Return the photograph at an absolute path, or as `Photographs.find_or_none`."""
        path = Path(label)
        return path if path.is_absolute() and path.is_file() else super().find_or_none(label, error, entry)


def _photo(camera: Element) -> str:
    return camera.need("photo").attribute("path")


def _resolve(frame_zip: Path, written: str) -> str:
    """The path of a photograph, as if the frame's zip file were a folder; unchanged if there is no such file."""
    path = Path(os.path.normpath(frame_zip / written.replace("\\", "/")))
    return str(path) if path.is_file() else written


def _frame(chunk: Element, chunk_zip: Path, number: int | None) -> Path:
    frames = {entry.attribute("id"): entry for entry in chunk.need("frames").all("frame")}
    if number is None and len(frames) > 1:
        got = f"{len(frames)} frames: {', '.join(list(frames)[:8])}"
        raise chunk.error("a frame number with --frame", got, "name one of them with --frame")
    key = next(iter(frames), "") if number is None else str(number)
    if key not in frames:
        raise chunk.error(f"one of the frames {', '.join(list(frames)[:8]) or '(none)'}", key or "none")
    return _below(chunk_zip.parent, frames[key].attribute("path"), frames[key])


def _below(folder: Path, written: str, element: Element) -> Path:
    """A path that a project's file names, inside its folder."""
    parts = PurePosixPath(written.replace("\\", "/")).parts
    if not parts or ".." in parts or parts[0] == "/" or "\0" in written:
        raise element.error("a path inside the project", written)
    return folder.joinpath(*parts)


def _document(archive: Path) -> Element:
    """The XML in a zip file of a project."""
    refuse = partial(InputError, "The Metashape project cannot be read", where=archive, fix=FIX)
    with open_file(archive, refuse) as stream:
        try:
            with zipfile.ZipFile(stream) as opened:
                info = opened.getinfo(_DOCUMENT)
                if info.compress_type not in _COMPRESSIONS or info.file_size > MAX_TEXT_BYTES:
                    got = f"compression {info.compress_type}, {info.file_size} bytes"
                    raise refuse(expected=f"{_DOCUMENT} deflated, at most {MAX_TEXT_BYTES} bytes", got=got)
                with opened.open(info) as member:
                    content = member.read(MAX_TEXT_BYTES + 1)
        except KeyError:
            raise refuse(expected=f"{_DOCUMENT} in the zip file", got="no such member") from None
        except (zipfile.BadZipFile, zlib.error, OSError, EOFError, ValueError, RuntimeError) as error:
            raise refuse(expected="a zip file", got=error) from None
    if len(content) > MAX_TEXT_BYTES:
        raise refuse(expected=f"at most {MAX_TEXT_BYTES} bytes", got="more")
    return parse_xml(content, f"{archive}, {_DOCUMENT}", refuse)


FORMAT = Format(
    name="metashape_project",
    title="Metashape project",
    files="one NAME.psx and NAME.files",
    detect=_detect,
    read=read,
    sequences=True,
)
