"""`gnmreg capture import`: captures of other programs become native capture folders."""

from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from workflows.cli.options import NOT_SET, OutputFolder

Source = Positional[Annotated[Path, arg(metavar="SRC")]]
OptionalName = Annotated[str | None, arg(metavar="NAME", help_behavior_hint=NOT_SET)]


def import_capture(
    source: Source,
    target: OutputFolder,
    /,
    format: Annotated[str | None, arg(metavar="F", help_behavior_hint="(default: detected)")] = None,
    subject: OptionalName = None,
    expression: OptionalName = None,
    frame: Annotated[int | None, arg(metavar="N", help_behavior_hint="(default: the first)")] = None,
    unit: Annotated[str | None, arg(metavar="UNIT", help_behavior_hint="(default: as the format says)")] = None,
) -> int:
    """Convert a capture of another program to a native capture folder.

    Images that need no change are copied as they are; lenses that a native capture cannot hold are undistorted.
    What was decided or left out is printed, and kept in the capture's import.json.

    Args:
        source: The capture: a folder, or its main file.
        target: The capture folder to write; it must not exist.
        format: The source's format, such as colmap or nerfstudio; docs/formats.md lists all.
        subject: Name of the subject, where the files do not say it or another is wanted.
        expression: Name of the expression, likewise; else neutral.
        frame: Frame or time step to import, of formats that hold sequences.
        unit: Unit of the source's world: m, cm, mm ..., or the metres of one unit as a number.
    """
    from registration.capture.native_writer import check_new
    from registration.formats import convert
    from registration.formats.registry import read_source
    from registration.formats.source import ReadOptions
    from registration.formats.units import parse_unit
    from registration.progress import console_progress

    unit_m = None if unit is None else parse_unit(unit)
    check_new(target)
    read = read_source(source, ReadOptions(subject=subject, expression=expression, frame=frame), name=format)
    with console_progress() as progress:
        done = convert.import_capture(read, target, unit_m=unit_m, progress=progress)
    print(f"{done.root}: {done.views} views from {done.format}, a unit of its world is {done.unit_m:g} m")
    for note in done.notes:
        print(f"note: {note}")
    print(f"next: gnmreg capture check {done.root}")
    return 0
