"""The size of the world by a measured length: the distance of two cameras, or of the person's pupils."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from registration.calibrate.assembly import Assembled
from registration.calibrate.options import CalibrateOptions
from registration.calibrate.photographs import Photograph
from registration.detect import face478_points
from registration.detect.face478 import SCHEME
from registration.errors import InputError
from registration.frames import MM_PER_M

_CAMERA_SIGMA_M = 5e-3  # of a measured distance of two cameras, whose centres lie inside the lenses
_PUPIL_SIGMA_MM = 1.5  # of the distance of two detected pupils


@dataclass(frozen=True, kw_only=True)
class Size:
    """How the world got its unit."""

    source: str  # what measured it
    head_scale: float  # the head's size in it, relative to the model fitted to the landmarks
    sigma: float  # relative standard deviation of the unit


def check_lengths(options: CalibrateOptions, photographs: Sequence[Photograph], scheme: str) -> None:
    """Refuse, before any work, lengths that cannot be used.

    Raises:
        InputError: a camera is of no photograph, both are the same, or the landmarks have no pupils.
    """
    if options.pupil_distance_mm is not None and scheme != SCHEME:
        raise InputError(
            "The landmarks have no pupils",
            where="--pupil-distance-mm",
            expected=f"landmarks of scheme {SCHEME}",
            got=scheme,
            fix="use --camera-distance instead",
        )
    if options.camera_distance is None:
        return
    first, second, _ = options.camera_distance
    names = {photograph.name for photograph in photographs}
    unknown = [name for name in (first, second) if name not in names]
    if unknown or first == second:
        raise InputError(
            "The distance of two cameras cannot be used",
            where="--camera-distance",
            expected="the names of two photographs, without suffix, and metres",
            got=", ".join(unknown) or f"{first} twice",
            fix=f"choose among {', '.join(sorted(names)[:6])}{', ...' if len(names) > 6 else ''}",
        )


def sized(
    assembled: Assembled,
    photographs: Sequence[Photograph],
    options: CalibrateOptions,
    left_out: Mapping[str, str],
) -> tuple[Assembled, Size]:
    """Return the views in a world of the measured unit; without a length, of the head model's.

    Args:
        assembled: in the model's frame and unit.
        photographs: of its views.
        options: hold the lengths; the cameras' is taken if both are given.
        left_out: photograph -> why it has no camera.

    Raises:
        InputError: one of the two cameras was left out, or a pupil was not seen by two views.
    """
    rig = assembled.adjusted.rig
    if options.camera_distance is not None:
        first, second, metres = options.camera_distance
        if missing := [name for name in (first, second) if name in left_out]:
            raise InputError(
                "The distance of two cameras cannot be used",
                where="--camera-distance",
                expected="two photographs that can be calibrated",
                got=f"{missing[0]}: {left_out[missing[0]]}",
                fix="give the distance of two other cameras",
            )
        names = [photograph.name for photograph in photographs]
        a, b = rig.positions[[names.index(first), names.index(second)]]
        length, sigma, source = metres, _CAMERA_SIGMA_M / metres, f"the distance of {first} and {second}"
    elif options.pupil_distance_mm is not None:
        a, b = assembled.adjusted.points[[face478_points.RIGHT_PUPIL, face478_points.LEFT_PUPIL]]
        seen = np.bincount(assembled.observations.point, minlength=assembled.landmark_count)
        if min(seen[face478_points.RIGHT_PUPIL], seen[face478_points.LEFT_PUPIL]) < 2:
            raise InputError(
                "The distance of the pupils cannot be used",
                where="--pupil-distance-mm",
                expected="both pupils in two photographs",
                got="fewer",
                fix="give --camera-distance instead",
            )
        length, source = options.pupil_distance_mm / MM_PER_M, "the distance of the pupils"
        sigma = _PUPIL_SIGMA_MM / options.pupil_distance_mm
    else:
        return assembled, Size(source="the head model", head_scale=1.0, sigma=assembled.model.scale_sigma)
    scale = length / float(np.linalg.norm(a - b))
    adjusted = replace(
        assembled.adjusted, rig=rig.moved(scale, np.eye(3), np.zeros(3)), points=scale * assembled.adjusted.points
    )
    return replace(assembled, adjusted=adjusted), Size(source=source, head_scale=scale, sigma=sigma)
