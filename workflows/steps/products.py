"""Products: the files that a step leaves in a folder, and beside them `step.json`, the step's result.

A product of the same inputs is not computed again. The result is written last, so an interrupted step leaves none and
can be repeated at any time; flows rely on that.
"""

from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Generic, TypeVar

from registration.storage.reading import read_json
from workflows.records.step_results import StepResult

FILE = "step.json"

R = TypeVar("R", bound=StepResult)


@dataclass(frozen=True)
class Product(Generic[R]):
    """The product of a step in a folder."""

    folder: Path
    input_hash: str  # of everything that determines the product
    result: type[R]

    def find(self) -> R | None:
        """Return the result of the product in the folder if it was computed from the same inputs, else None.

        The folder may have been moved since: the caller replaces the paths in the result.

        Raises:
            InputError: `step.json` is malformed.
        """
        file = self.folder / FILE
        if not file.is_file():
            return None
        value = self._read(file)
        return self.result.from_json(value, where=file) if value["input_hash"] == self.input_hash else None

    def write(self, result: R, folder: Path | None = None) -> None:
        """Write the result, into `folder` if the product is still in a temporary one."""
        result.write((folder or self.folder) / FILE)

    def _read(self, file: Path) -> dict[str, Any]:
        """The JSON object. Other fields than the hash are not checked: another version may have written it."""
        value = read_json(file, partial(self.result.invalid, file))
        if not isinstance(value, dict) or not isinstance(value.get("input_hash"), str):
            raise self.result.invalid(file, expected='an object with "input_hash"', got="no such field")
        return value
