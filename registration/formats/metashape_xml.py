"""Cameras that Agisoft Metashape or PhotoScan exported as XML (File > Export > Export Cameras): `cameras.xml`."""

from pathlib import Path

from registration.formats.metashape_chunk import only_chunk, read_chunk
from registration.formats.photographs import Photographs, scan_beside
from registration.formats.source import Format, ReadOptions, SourceCapture
from registration.formats.xml_files import read_xml
from registration.formats.xml_head import need_xml_file, xml_file


def _detect(path: Path) -> bool:
    return xml_file(path, "document") is not None


def read(path: Path, options: ReadOptions) -> SourceCapture:
    """Read exported cameras; photographs are looked for in the file's folder and below.

    Raises:
        InputError: the file is missing or malformed, or as `registration.formats.metashape_chunk.read_chunk`.
    """
    file = need_xml_file(path, "document")
    document = read_xml(file)
    if document.name != "document":
        raise document.error("the element <document> of Metashape", f"<{document.name}>")
    chunk = only_chunk(document.all("chunk"), document.error("an enabled <chunk>", "none"))
    result = read_chunk(chunk, Photographs(file.parent), file.parent)
    scan = scan_beside(file.parent)
    notes = result.notes
    if scan is not None and not result.local:
        notes, scan = (*notes, f"{scan.name} was left out: its world may be another"), None
    return SourceCapture(
        format=FORMAT.name,
        root=file.parent,
        subject=options.subject or file.parent.resolve().name,
        expression=options.expression or "neutral",
        views=result.views,
        unit_m=result.unit_m,
        scan=scan,
        notes=notes,
    )


FORMAT = Format(
    name="metashape",
    title="Metashape cameras as XML",
    files="an XML file with <document> and <chunk>",
    detect=_detect,
    read=read,
)
