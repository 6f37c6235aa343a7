"""What a step leaves: files, and beside them `step.json` with the hash of what they were made from."""

import json
from pathlib import Path
from typing import Any

from registration.storage import hashing

STEP = "step.json"
JsonRecord = dict[str, Any]  # JSON values


def find_product(folder: Path, input_hash: str) -> JsonRecord | None:
    """Return the record of the product in `folder` if it was made from these inputs, else None.

    The folder may have been moved since: paths in the record are not to be trusted.
    """
    try:
        record = json.loads((folder / STEP).read_text("utf-8"))
    except (OSError, ValueError):
        return None
    return record if isinstance(record, dict) and record.get("input_hash") == input_hash else None


def json_text(value: Any) -> str:
    """A record as the text of a JSON file."""
    return json.dumps(hashing.to_jsonable(value), indent=1, allow_nan=False) + "\n"
