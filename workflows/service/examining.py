"""What a library process does for uploads: the doctor's checks, which decode images."""

from pathlib import Path
from typing import Any

from registration.doctor.diagnosis import diagnose


def examine(folder: str, name: str) -> dict[str, Any]:
    """Return what the checks of a capture find.

    Args:
        folder: of the capture.
        name: that messages give it, instead of the folder.

    Returns:
        errors: one object for each, with the parts of an `InputError`; warnings: lines; subject and expression, views.
    """
    diagnosis = diagnose(Path(folder))
    capture = diagnosis.as_written

    def shown(text: str) -> str:
        return text.replace(folder, name)

    errors = [finding.error for finding in diagnosis.errors]
    warnings = [finding for finding in diagnosis.findings if finding.severity == "warning"]
    return {
        "errors": [
            {part: shown(getattr(error, part)) for part in ("what", "where", "expected", "got", "fix")}
            for error in errors[:100]
        ],
        "warnings": [shown(finding.line)[:1000] for finding in warnings[:100]],
        "subject": capture.subject if capture is not None else "",
        "expression": capture.expression if capture is not None else "",
        "views": len(capture.views) if capture is not None else 0,
    }
