"""`gnmreg capture import` and `dataset import`: captures and datasets of other programs become native ones."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from registration.errors import InputError
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


@dataclass(frozen=True, kw_only=True)
class SelectionOptions:
    """What of a dataset is imported.

    Attributes:
        format: Only recordings of this format, such as nersemble; docs/formats.md lists all.
        subjects: Names of the subjects to import, or patterns such as 01*, separated by commas.
        expressions: Names of the expressions or sequences to import, or patterns, separated by commas.
        frames: Frame numbers of each sequence, separated by commas; several become several captures.
        neutral: Expression whose first frame is each subject's neutral, without which no subject is registered; else
            the one with neutral in its name.
        unit: Unit of the source's world: m, cm, mm ..., or the metres of one unit as a number.
    """

    format: Annotated[str | None, arg(metavar="F", help_behavior_hint="(default: detected)")] = None
    subjects: Annotated[str, arg(metavar="A,B", help_behavior_hint="(default: all)")] = ""
    expressions: Annotated[str, arg(metavar="A,B", help_behavior_hint="(default: all)")] = ""
    frames: Annotated[str, arg(metavar="N,M", help_behavior_hint="(default: the first)")] = ""
    neutral: Annotated[str | None, arg(metavar="NAME", help_behavior_hint="(default: by its name)")] = None
    unit: Annotated[str | None, arg(metavar="UNIT", help_behavior_hint="(default: as the format says)")] = None


_ALL = SelectionOptions()


def import_dataset(
    source: Source,
    target: OutputFolder,
    /,
    selection: SelectionOptions = _ALL,
    jobs: Annotated[int, arg(metavar="N")] = 1,
) -> int:
    """Convert a dataset in another layout, as NeRSemble or Multiface, to ours.

    Run again, the command resumes: complete captures are kept, failed ones are tried again.

    Args:
        source: The dataset's folder: subjects with their recordings, or one subject.
        target: The dataset to write: one folder for each subject, with one capture for each expression and frame.
        selection: What of the dataset is imported.
        jobs: Captures imported in parallel.
    """
    from registration.progress import console_progress
    from workflows.steps import import_dataset as step

    chosen = step.Selection(
        format=selection.format,
        subjects=_words(selection.subjects),
        expressions=_words(selection.expressions),
        frames=_numbers(selection.frames),
        neutral=selection.neutral,
        unit=selection.unit,
    )
    with console_progress() as progress:
        record = step.import_dataset(source, target, chosen, jobs=jobs, progress=progress)
    failed = record.failed
    for note in dict.fromkeys(note for row in record.rows for note in row.notes):
        print(f"note: {note}")
    for row in failed:
        print(f"failed: {row.folder}: {row.reason}")
    done = sum(row.status == "imported" for row in record.rows)
    print(f"{target}: {done} of {len(record.rows)} captures")
    for subject in step.without_neutral(record):
        print(f"note: {subject} has no neutral: say with --neutral which expression it is")
    return 2 if not done else 1 if failed else 0


def _words(text: str) -> tuple[str, ...]:
    return tuple(word for part in text.split(",") if (word := part.strip()))


def _numbers(text: str) -> tuple[int, ...]:
    words = _words(text)
    if not all(word.isdecimal() and len(word) < 10 for word in words) or len(set(words)) < len(words):
        raise InputError(
            "Cannot read the frame numbers",
            where="--frames",
            expected="different whole numbers separated by commas, e.g. 0,30,60",
            got=text,
            fix="write numbers from 0",
        )
    return tuple(int(word) for word in words)
