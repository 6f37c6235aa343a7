"""The record of an imported dataset: which captures were imported from where, and which failed."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from registration.storage.records import Record, json_key

MANIFEST = "import.json"

Status = Literal["waiting", "imported", "failed"]


@dataclass(frozen=True, kw_only=True)
class ImportRow:
    """One capture of an imported dataset."""

    folder: str  # of the capture, within the dataset
    source: str  # folder of the recording, within the source
    format: str
    frame: int | None  # None: the format's default
    status: Status = "waiting"
    reason: str = ""  # of a failure
    notes: tuple[str, ...] = ()  # what was decided or left out


@dataclass(frozen=True, kw_only=True)
class DatasetImportRecord(
    Record, kind="gnm-dataset-import", title="record of the imported dataset", fix="choose another folder"
):
    """`import.json`. A repeated import must have the same first four fields."""

    source: Path
    frames: tuple[int, ...]
    neutral: str | None
    unit: str | None
    rows: tuple[ImportRow, ...] = json_key("captures", default=())

    @property
    def failed(self) -> tuple[ImportRow, ...]:
        """The captures that could not be imported."""
        return tuple(row for row in self.rows if row.status == "failed")
