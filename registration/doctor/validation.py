"""Checks of a capture before anything is computed: cameras, image files, landmarks and units."""

from registration.doctor.examination import Examination
from registration.doctor.ledger import Ledger
from registration.types import Capture


def validate_capture(capture: Capture, *, use_scan: bool = True) -> Ledger:
    """Check a capture before it is registered: the headers of all views first, then contents.

    Masks and label maps are decoded whole. Images of more than `samples.MAX_DECODED_PIXELS` are only checked for
    truncation, and so are all but some normal maps of more; other damage is reported when the views are decoded for the
    fit.

    Args:
        capture: as read.
        use_scan: whether the scan's normals stand in for missing normal maps.

    Returns:
        What of the capture counts, and what may be wrong with it.

    Raises:
        InputError: fewer than two views, a singular or non-finite camera, a missing or damaged file, a size that is not
            the camera's, landmarks, a scan or true vertices that cannot be used or are in another unit or frame than
            the cameras, a world that is not in metres, or a kind of data of which nothing counts.
    """
    examination = Examination(capture, use_scan=use_scan)
    if examination.errors:
        raise examination.errors[0].error
    assert examination.ledger is not None
    return examination.ledger
