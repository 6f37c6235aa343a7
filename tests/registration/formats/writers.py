"""The writers of `tests/fixtures/formats`, one for each format, and captures that went through one."""

import importlib
from dataclasses import replace
from pathlib import Path
from types import ModuleType

from registration.capture import native
from registration.formats.convert import import_capture
from registration.formats.registry import FORMATS, detect_format, read_source
from registration.formats.source import ReadOptions
from registration.types import Capture

NAMES = [known.name for known in FORMATS]


def writer_of(name: str) -> ModuleType:
    """The module that writes a format; each format needs one."""
    return importlib.import_module(f"tests.fixtures.formats.{name}")


def with_square_pixels(capture: Capture) -> Capture:
    """The capture with one focal length: its images only serve to be copied."""
    cameras = [replace(view.camera, intrinsics=view.camera.intrinsics.copy()) for view in capture.views]
    for camera in cameras:
        camera.intrinsics[1, 1] = camera.intrinsics[0, 0]
    views = [replace(view, camera=camera) for view, camera in zip(capture.views, cameras, strict=True)]
    return replace(capture, views=tuple(views))


def written_names(writer: ModuleType, capture: Capture) -> list[str]:
    """The names of views that a writer gives, which its format prescribes."""
    if getattr(writer, "NUMBERED", False):
        return [str(number) for number in range(len(capture.views))]
    return [getattr(writer, "PREFIX", "") + view.name for view in capture.views]


def written_and_imported(name: str, capture: Capture, folder: Path) -> Capture:
    """Write a capture in a format, detect it, and return what was imported, in `folder/native`."""
    source_folder = folder / "source"
    source_folder.mkdir()
    writer_of(name).write(capture, source_folder)
    assert detect_format(source_folder).name == name
    source = read_source(source_folder, ReadOptions(subject=capture.subject, expression=capture.expression))
    import_capture(source, folder / "native", unit_m=1.0 if source.unit_m is None else None)
    return native.read_capture(folder / "native")
