"""What a missing channel costs, as measured (docs/photographs.md, "What it costs to leave steps out")."""

from collections.abc import Sequence

from registration.types import Capture

_WITH_ALL = "0.28 mm"  # mean distance of the face's scan from the mesh, from photographs and cameras alone
_WITHOUT_NORMALS = "0.97 mm"


def missing_notes(capture: Capture, schemes: Sequence[str]) -> tuple[str, ...]:
    """Return a note for each channel that a completed capture still lacks, with what that is expected to cost.

    Args:
        capture: with all that was made.
        schemes: landmark schemes of the model.
    """
    notes = []
    if not any(view.has_normals for view in capture.views) and capture.scan is None:
        notes.append(
            "there are neither normals nor depths nor a scan: of a measured head the face was then "
            f"{_WITHOUT_NORMALS} off on average, instead of {_WITH_ALL}"
        )
    return tuple(notes)
