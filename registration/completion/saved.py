"""Completions in the cache: made once for the same inputs, kept until the cache is full."""

import shutil
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from registration.completion.channels import attach
from registration.completion.pictures import SHEET, draw_made
from registration.progress import Progress
from registration.segment.fitted import CLASSES
from registration.storage.cache import cache_folder, make_cache_folder
from registration.storage.files import atomic_directory, read_json_of_kind, write_json
from registration.types import Capture

CHANNELS = ("landmarks", "masks", "segmentation", "normals", "depth", "confidence")  # folders of the made files
RECORD, KIND, SCHEMA = "completion.json", "gnm-completion", 1
_MOST_BYTES = 4 * 2**30  # of all completions; the oldest are deleted


@dataclass(frozen=True, kw_only=True)
class Completion:
    """A capture with the channels that were made for it."""

    capture: Capture
    folder: Path  # of the made channels, laid out as a native capture
    head_rows: Mapping[str, int] | None  # view's name -> height of the head, px of the stored image
    notes: tuple[str, ...]  # for the user
    figures: Mapping[str, Any]
    seconds: Mapping[str, float]  # step -> duration

    @property
    def sheet(self) -> Path:
        """The picture of what was made."""
        return self.folder / SHEET


def completed(
    capture: Capture, key: str, make: Callable[[Path], Mapping[str, Any]], scheme: str, progress: Progress
) -> Completion:
    """Return the completion of a capture from the cache, or make it.

    Args:
        capture: as it was given.
        key: digest of all that decides the result.
        make: writes the channels into a folder and returns the record of it (`Completer.complete`).
        scheme: of the landmarks that the picture shows.
        progress: where to report to.

    Raises:
        InputError: as `make`; nothing is kept.
    """
    folder = completions_folder() / key[:32]
    record = read_json_of_kind(folder / RECORD, KIND)
    if record is None or record.get("schema") != SCHEMA:
        make_cache_folder(folder.parent)
        with atomic_directory(folder) as temporary:
            made = {"kind": KIND, "schema": SCHEMA, "key": key, **make(temporary)}
            write_json(temporary / RECORD, made)
            draw_made(attach(capture, temporary, CLASSES), scheme, temporary / SHEET)
        record = read_json_of_kind(folder / RECORD, KIND)
        assert record is not None
        _prune(folder)
    else:
        progress.message(f"what the capture lacks was made before: {folder}")
    return Completion(
        capture=attach(capture, folder, CLASSES),
        folder=folder,
        head_rows=record["head_rows"],
        notes=tuple(record["notes"]),
        figures=record["figures"],
        seconds=record["seconds"],
    )


def completions_folder() -> Path:
    """Return the folder of all completions. Raises RuntimeError if the user has no home folder."""
    return cache_folder() / "completions"


def _prune(newest: Path) -> None:
    """Delete the oldest completions until the rest is small enough."""
    folders = [path for path in newest.parent.iterdir() if path.is_dir() and not path.name.startswith(".")]
    total = 0
    for folder in sorted(folders, key=lambda path: -path.stat().st_mtime):
        total += sum(file.stat().st_size for file in folder.rglob("*") if file.is_file())
        if total > _MOST_BYTES and folder != newest:
            shutil.rmtree(folder, ignore_errors=True)
