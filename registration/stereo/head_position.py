"""Where the head is, for stereo alone: from landmarks in space, or from masks."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from registration.capture.pixels import read_mask
from registration.capture.triangulation import triangulate
from registration.doctor.rig_checks import MaskBox, mask_box, subject_centre, subject_extent
from registration.errors import InputError
from registration.types import Camera, Capture

_INTO_M = 0.06  # from the landmarks of a face to the middle of the head
_RADIUS_M = 0.145  # of a sphere that holds face, skull and ears
_LARGEST_M = 0.2  # radius around masks, which show shoulders too
_LEAST_LANDMARKS = 5
_INSIDE = 128


@dataclass(frozen=True, kw_only=True, eq=False)
class HeadPosition:
    """A sphere around a head."""

    centre: Float[np.ndarray, "3"]  # world, metres
    radius_m: float


def find_head(capture: Capture) -> HeadPosition:
    """Find the head of a capture in metres.

    Args:
        capture: with landmarks of any scheme in two views, or masks in three.

    Raises:
        InputError: it has neither, or a mask cannot be decoded.
    """
    for scheme in sorted({scheme for view in capture.views for scheme in view.landmarks}):
        points = triangulate(capture, scheme)[0]
        points = points[np.isfinite(points).all(1)]
        if len(points) >= _LEAST_LANDMARKS:
            return around_face(points, [view.camera for view in capture.views if scheme in view.landmarks])
    boxes: dict[str, MaskBox | None] = {}
    for view in capture.views:
        if view.mask is not None:
            boxes[view.name] = mask_box(read_mask(view.mask, view.camera) >= _INSIDE)
    centre, extent = subject_centre(capture, boxes), subject_extent(capture, boxes)
    if centre is None or extent is None:
        raise InputError(
            "The head cannot be located",
            where=capture.root,
            expected=f"{_LEAST_LANDMARKS} landmarks that two views agree on, or masks of three views",
            got=f"{sum(box is not None for box in boxes.values())} masks",
            fix="add landmarks or masks",
        )
    return HeadPosition(centre=centre, radius_m=float(np.clip(extent / 2, _RADIUS_M, _LARGEST_M)))


def around_face(points: Float[np.ndarray, "P 3"], cameras: Sequence[Camera]) -> HeadPosition:
    """Return the sphere of a head whose face has these points (world, metres) and looks towards the cameras."""
    middle = np.median(points, axis=0)
    towards = np.stack([camera.centre for camera in cameras]) - middle
    towards = (towards / np.linalg.norm(towards, axis=1, keepdims=True)).mean(0)
    towards /= max(float(np.linalg.norm(towards)), 1e-9)
    return HeadPosition(centre=middle - _INTO_M * towards, radius_m=_RADIUS_M)
