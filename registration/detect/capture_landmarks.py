"""The landmarks that were detected in a capture, with what was seen, refused and doubted."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
from jaxtyping import Float, Int

from registration.detect.provider import Face
from registration.errors import InputError
from registration.types import Camera, Capture

PLAIN = "face"  # the note of a view where nothing is remarkable
ViewState = Literal["used", "none", "refused"]  # its face is used; it shows none; its faces contradict other views
Outcome = Literal["found", "one view", "no face", "contradictory", "mirrored"]


@dataclass(frozen=True, kw_only=True, eq=False)
class ViewDetection:
    """What was detected in one view. L is 0 in a view whose state is not `used`."""

    name: str
    state: ViewState
    note: str  # what was seen, and why a face was refused
    camera: Camera  # of the undistorted image, whose pixels the faces are in
    faces: tuple[Face, ...] = ()  # all that were found
    chosen: int | None = None  # position of the subject's
    landmarks: Float[np.ndarray, "L 3"] = field(default_factory=lambda: np.zeros((0, 3)))  # x_px y_px confidence
    spread_px: Float[np.ndarray, "L"] = field(default_factory=lambda: np.zeros(0))
    residual_px: Float[np.ndarray, "L"] = field(default_factory=lambda: np.zeros(0))  # NaN: not seen, or no point
    outliers: tuple[int, ...] = ()  # landmarks that contradict the other views; their confidence is 0

    @property
    def caption(self) -> str:
        """What was seen, and how far it is from the other views, in words."""
        if self.state != "used":
            return self.note
        known = self.residual_px[np.isfinite(self.residual_px)]
        measured = f"{np.median(known):.1f} px off" if len(known) else "unconfirmed"
        return measured if self.note == PLAIN else f"{measured}; {self.note}"


@dataclass(frozen=True, kw_only=True, eq=False)
class CaptureLandmarks:
    """Landmarks of one scheme in all views and in space.

    Landmarks and spreads of views are in pixels of the stored images, with the lens' distortion; the faces, residuals
    and cameras of `ViewDetection` are of the undistorted ones.
    """

    scheme: str
    version: str  # of the provider
    outcome: Outcome
    reason: str  # in words
    views: tuple[ViewDetection, ...]  # in the capture's order
    points: Float[np.ndarray, "L 3"]  # world, metres; NaN where fewer than two views agree
    used: Int[np.ndarray, "L"]  # how many views each point is of
    point_residual_px: Float[np.ndarray, "L"]  # root mean square over these views
    hints: Mapping[str, float] = field(default_factory=dict)  # blendshape -> score in [0, 1], median of frontal views
    warnings: tuple[str, ...] = ()

    @property
    def usable(self) -> bool:
        """Whether any view has landmarks that may be used."""
        return self.outcome in ("found", "one view")

    def into(self, capture: Capture) -> Capture:
        """Return the capture with these landmarks in its views, in place of others of the scheme."""
        found = {view.name: view for view in self.views if len(view.landmarks)}
        views = []
        for view in capture.views:
            landmarks = {name: rows for name, rows in view.landmarks.items() if name != self.scheme}
            spreads = {name: rows for name, rows in view.landmark_spread_px.items() if name != self.scheme}
            if view.name in found:
                landmarks[self.scheme] = found[view.name].landmarks
                spreads[self.scheme] = found[view.name].spread_px
            views.append(replace(view, landmarks=landmarks, landmark_spread_px=spreads))
        return replace(capture, views=tuple(views))

    def error(self, capture: Capture) -> InputError:
        """Return the error that says why nothing is usable."""
        fixes = {
            "no face": "add views of the face; a face that the pictures show clearly can be given as landmark files",
            "mirrored": "mirror the images back, or correct the cameras",
        }
        return InputError(
            "The landmarks of the photographs cannot be used",
            where=capture.root,
            expected="one face that at least two views agree on",
            got=self.reason,
            fix=fixes.get(
                self.outcome, "use photographs of one moment with their own cameras; check which camera has which image"
            ),
        )
