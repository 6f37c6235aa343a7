"""Landmarks of captures in the corrected order of the scheme of 68 points (`registration.model.jaw_order`)."""

from dataclasses import replace

import numpy as np

from registration.capture.triangulation import triangulate
from registration.model import jaw_order
from registration.types import Capture, View


def has_reversed_jaw(capture: Capture) -> bool:
    """Return whether the capture's 68 landmarks, triangulated, have points 2 to 6 in the reverse order."""
    return jaw_order.is_reversed(triangulate(capture, jaw_order.SCHEME)[0])


def with_corrected_jaw(capture: Capture) -> Capture:
    """Return the capture with its 68 landmarks in the corrected order: the same one, if they have it."""
    if not has_reversed_jaw(capture):
        return capture
    return replace(capture, views=tuple(map(_turned, capture.views)))


def _turned(view: View) -> View:
    if (points := view.landmarks.get(jaw_order.SCHEME)) is None:
        return view
    spreads = dict(view.landmark_spread_px)
    if (spread_px := spreads.get(jaw_order.SCHEME)) is not None:
        spreads[jaw_order.SCHEME] = np.asarray(spread_px)[jaw_order.TURNED]
    turned = {**view.landmarks, jaw_order.SCHEME: np.asarray(points)[jaw_order.TURNED]}
    return replace(view, landmarks=turned, landmark_spread_px=spreads)
