"""Whether the world is in metres, by the landmarks."""

from collections.abc import Mapping

import numpy as np
from jaxtyping import Float

from registration.capture import triangulation
from registration.doctor import exchanged, rig_checks
from registration.doctor.findings import Finding, refuse
from registration.doctor.length_units import plausible_units, wrong_unit
from registration.doctor.mesh_frame import UNITS
from registration.types import Capture

EYE_DISTANCE_M = (0.05, 0.15)  # between the outer corners
_MOST_EYES_M = (0.07, 0.115)  # of most people, from children to large adults: names a unit
_LABELLED_HEAD_M = (0.1, 0.65)  # with hair
_BUST_M = 0.75  # the longer side of a head with shoulders
OUTER_EYES = (36, 45)  # of the 68 scheme


def check_scheme_length(capture: Capture) -> None:
    """Refuse a scheme 68 of another length. Raises InputError."""
    counts = {len(view.landmarks["68"]) for view in capture.views if "68" in view.landmarks}
    if counts - {68}:
        raise refuse(
            "landmarks-scheme",
            'The landmark scheme "68" has another length',
            where=capture.root / "landmarks",
            expected="68 points",
            got=", ".join(map(str, sorted(counts))),
            fix="give another scheme another name",
        )


def check_size(capture: Capture, points: Float[np.ndarray, "L 3"]) -> bool:
    """Check the unit of the world by landmarks.

    Args:
        capture: with landmarks.
        points: triangulated, of scheme 68, m; L = 0 without.

    Returns:
        Whether they confirm it.

    Raises:
        InputError: they are too large or too small for a head.
    """
    distance = eye_distance(points)
    if distance is None:
        for name in sorted({name for view in capture.views for name in view.landmarks}):
            rig_checks.check_landmark_size(capture, name, triangulation.triangulate(capture, name)[0])
        return False
    if EYE_DISTANCE_M[0] <= distance <= EYE_DISTANCE_M[1]:
        return True
    if contradict := exchanged.views_that_contradict(capture, points):
        raise refuse(
            "views-exchanged",
            "The landmarks of some views contradict the others",
            where=capture.root / "landmarks",
            expected="landmarks of one face in all views",
            got="; ".join(contradict),
            fix="mend these views, or remove their landmarks",
        )
    raise wrong_unit(
        capture,
        "The outer eye corners are too close or too far apart: check that the units are metres",
        f"{EYE_DISTANCE_M[0]} to {EYE_DISTANCE_M[1]} m between the triangulated landmarks 36 and 45",
        f"{distance:.4g} m",
        extent=distance,
        limits_m=_MOST_EYES_M,
    )


def check_head_size(capture: Capture, heads: Mapping[str, rig_checks.MaskBox | None]) -> None:
    """Refuse a head, as labels show it, that is larger or smaller than one. Raises InputError."""
    extent = rig_checks.subject_extent(capture, heads)
    if extent is not None:
        rig_checks.check_extent(capture, "labels", extent, _LABELLED_HEAD_M, rig_checks.HEAD_M)


def large_subject(capture: Capture, boxes: Mapping[str, rig_checks.MaskBox | None]) -> list[Finding]:
    """A warning of masks that show more than a head: it may be a person to the waist, or a world in another unit."""
    extent = rig_checks.subject_extent(capture, boxes)
    if extent is None or extent <= _BUST_M:
        return []
    units = [f"by {UNITS[name]:g} if it is in {name}" for name in plausible_units(extent, rig_checks.HEAD_M)]
    line = f"the masks show a subject of {extent:.2g} m, a head with its neck has about 0.3; if it is no larger, "
    return [Finding.warning("unit", f"{line}scale the COLMAP model and the scan {' or '.join(units) or 'to metres'}")]


def eye_distance(points: Float[np.ndarray, "L 3"]) -> float | None:
    """Return the distance (m) between the outer eye corners; None for another scheme than 68 or a NaN corner."""
    if len(points) != 68:
        return None
    right, left = points[list(OUTER_EYES)]
    distance = float(np.linalg.norm(right - left))
    return distance if np.isfinite(distance) else None
