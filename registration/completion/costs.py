"""What a missing channel costs, as it was measured (docs/recipes.md, "From photographs")."""

from registration.types import Capture

# Mean distance of the scan of a measured face from its mesh, from photographs and cameras: with what is made, without.
_COMPLETE, _NO_NORMALS = "0.28 mm", "0.97 mm"


def missing_notes(capture: Capture) -> tuple[str, ...]:
    """Return a note for what a capture lacks although it may be completed, with the error that is to be expected.

    Args:
        capture: with all that was made.
    """
    if not capture.photographs or capture.scan is not None or any(view.has_normals for view in capture.views):
        return ()
    expected = f"of a measured head the face was {_NO_NORMALS} off on average without them, {_COMPLETE} with them"
    return (f"there are neither normals nor depths nor a scan: {expected}",)
