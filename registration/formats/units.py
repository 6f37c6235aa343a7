"""The length of a world's unit: stated by the user or the format, or else estimated from the subject's size."""

from collections.abc import Iterator, Sequence

import numpy as np

from registration.capture.scan import read_scan
from registration.capture.settings import UNITS_M
from registration.capture.triangulation import triangulate
from registration.doctor.size_checks import EYE_DISTANCE_M, eye_distance
from registration.errors import InputError
from registration.formats.mask_size import mask_size
from registration.formats.plan import ViewPlan
from registration.formats.registry import find_format
from registration.formats.source import SourceCapture
from registration.types import Capture, View

_ADULT_EYES_M = 0.09  # between the outer corners of adults' eyes
_HEAD_M = (0.12, 0.7)  # longer side of what is scanned of a head: a face to a head with shoulders
_TRIED = ("m", "cm", "mm")


def parse_unit(text: str) -> float:
    """Return metres per unit of a name such as "mm", or of a number. Raises InputError."""
    name = text.strip().lower()
    if name in UNITS_M:
        return UNITS_M[name]
    try:
        metres = float(name)
    except ValueError:
        metres = 0.0
    if not (0 < metres < float("inf")):
        expected = f"{', '.join(UNITS_M)}, or a number of metres above 0"
        raise InputError("There is no such unit", where="--unit", expected=expected, got=text, fix="name one of these")
    return metres


def world_unit(source: SourceCapture, plans: Sequence[ViewPlan], given_m: float | None) -> tuple[float, str | None]:
    """Return metres per unit of a capture's world, and a note if it was not simply known.

    Args:
        source: the capture.
        plans: of its views.
        given_m: metres per unit according to the user; counts before the format's own.

    Raises:
        InputError: nobody says it, and neither landmarks of scheme 68 nor, in a format of physical units, a scan or
            masks let it be estimated.
    """
    if given_m is not None:
        if source.unit_m is not None and not np.isclose(given_m, source.unit_m):
            return given_m, f"--unit was followed, {given_m:g} m; the format has {source.unit_m:g} m"
        return given_m, None
    if source.unit_m is not None:
        return source.unit_m, None
    if (eyes := _eye_distance(source, plans)) is not None:
        return _from_eyes(eyes)
    if find_format(source.format).physical:
        for what, extent in _extents(source, plans):
            for name in _TRIED:
                if _HEAD_M[0] <= extent * UNITS_M[name] <= _HEAD_M[1]:
                    size = f"{what} would be {extent * UNITS_M[name]:.2g} m large"
                    return UNITS_M[name], f"the world's unit was taken for {name}: {size}; --unit says it if not"
    raise InputError(
        "The unit of the capture's world is not known",
        where=source.root,
        expected="landmarks of scheme 68, a scan or masks of a head, or the unit",
        got=f"none of them; {source.format} does not state the unit",
        fix="say it with --unit m, cm, mm, or the metres of one unit as a number, e.g. --unit 0.152",
    )


def _extents(source: SourceCapture, plans: Sequence[ViewPlan]) -> Iterator[tuple[str, float]]:
    """What may show a head, and its longest side in the world's unit."""
    if source.scan is not None:
        yield "the scan", float(np.ptp(read_scan(source.scan).vertices, axis=0).max())
    if (size := mask_size(plans)) is not None:
        yield "what the masks show", size


def _eye_distance(source: SourceCapture, plans: Sequence[ViewPlan]) -> float | None:
    views = []
    for plan in plans:
        landmarks = plan.view.landmarks.get("68")
        if landmarks is not None:
            points = landmarks if plan.lens is None else plan.lens.landmarks(landmarks)
            views.append(View(name=plan.view.name, camera=plan.camera, image=source.root, landmarks={"68": points}))
    if len(views) < 2:
        return None
    capture = Capture(root=source.root, subject="", expression="", views=tuple(views))
    return eye_distance(triangulate(capture, "68")[0])


def _from_eyes(distance: float) -> tuple[float, str]:
    for name in _TRIED:
        if EYE_DISTANCE_M[0] <= (metres := distance * UNITS_M[name]) <= EYE_DISTANCE_M[1]:
            apart = f"the outer corners of the eyes are {100 * metres:.1f} cm apart then"
            return UNITS_M[name], f"the world's unit was taken for {name}: {apart}; --unit says it if it is another"
    unit_m = _ADULT_EYES_M / distance
    return unit_m, (
        f"the world has a scale of its own: {unit_m:.4g} m a unit was estimated, so that the outer corners of the eyes "
        f"are {100 * _ADULT_EYES_M:g} cm apart, as an adult's on average, to about 10 %; measure a distance and give "
        "--unit where sizes matter"
    )
