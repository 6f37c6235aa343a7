"""What a capture lacks, and what of it is made from its photographs."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from registration.capture.class_names import BACKGROUND
from registration.capture.triangulation import triangulate
from registration.fit.initialization import MIN_LANDMARKS
from registration.model.landmarks import LandmarkScheme
from registration.types import Capture

_FEW = 0.5  # of the views: a channel that fewer have is made for the others


@dataclass(frozen=True, kw_only=True)
class CompletionPlan:
    """The channels to make."""

    landmarks: bool = False
    masks: bool = False
    labels: bool = False
    normals: bool = False  # with depths and confidences

    @property
    def empty(self) -> bool:
        """Whether nothing is to be made."""
        return not (self.landmarks or self.masks or self.labels or self.normals)

    @property
    def channels(self) -> tuple[str, ...]:
        """Names of the channels, in the order in which they are made."""
        made = {"landmarks": self.landmarks, "masks": self.masks, "labels": self.labels, "normals": self.normals}
        return tuple(name for name, wanted in made.items() if wanted)


def plan_completion(
    capture: Capture,
    schemes: Mapping[str, LandmarkScheme],
    *,
    detected: str | None = "face478",
    stereo: bool = True,
    use_scan: bool = True,
) -> CompletionPlan:
    """Return what is to be made.

    Masks and normals are made, for the views that lack them, if fewer than half of the views have them; labels if no
    view has any. Landmarks are detected if the capture has too few of any scheme that the model has, and for the labels
    of eyes and lips. Captures whose images show no colours of the subject are left as they are.

    Args:
        capture: as it was read.
        schemes: landmark schemes of the model.
        detected: scheme of the landmarks that may be detected, and used for masks and labels; None: nothing may be
            detected. Of a scheme that the model has no map of, no landmarks are detected.
        stereo: whether depths and normals may be made.
        use_scan: whether a scan's normals may stand in for normal maps.
    """
    if not capture.photographs or len(capture.views) < 2:
        return CompletionPlan()
    few = _FEW * len(capture.views)
    labelled = any(view.segmentation is not None for view in capture.views)
    masked = sum(view.mask is not None for view in capture.views) >= few or (labelled and BACKGROUND in capture.classes)
    scanned = use_scan and capture.scan is not None
    lacks = not labelled or not has_landmarks(capture, schemes)
    return CompletionPlan(
        landmarks=lacks and detected in schemes and not _given(capture, detected),
        masks=not masked,
        labels=detected is not None and not labelled,
        normals=stereo and not scanned and sum(view.has_normals for view in capture.views) < few,
    )


def has_landmarks(capture: Capture, schemes: Mapping[str, LandmarkScheme]) -> bool:
    """Return whether enough landmarks of a scheme of the model agree over the views to locate the head."""
    shared = {name for view in capture.views for name in view.landmarks} & set(schemes)
    return any(np.isfinite(triangulate(capture, name)[0]).all(1).sum() >= MIN_LANDMARKS for name in shared)


def _given(capture: Capture, scheme: str | None) -> bool:
    return any(scheme in view.landmarks for view in capture.views)
