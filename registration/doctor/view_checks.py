"""What may be wrong with single views: lenses, exposure, cameras that do not see the subject, a face that none sees."""

from collections.abc import Iterable, Sequence

import cv2
import numpy as np
from jaxtyping import Float

from registration.capture.samples import ViewSample
from registration.capture.text import listed
from registration.doctor.findings import Finding, refuse
from registration.frames import opencv_intrinsics, srgb_to_linear
from registration.types import Camera, Capture

_FACE = ("left_eye", "right_eye", "upper_lip", "lower_lip")  # classes that a view of a face shows
_MIN_SAMPLES = 3
_NEAR_VIEWS = 3
_STOPS = 1.2  # by which a view is brighter than those beside it and than most
_SATURATED, _FEW_SATURATED = 0.3, 0.05  # shares of the subject that are white
_WHITE = 0.97
_BLACK = 1e-3
_MIN_SKIN = 0.05  # of the subject, below which its light is not known
_MARGIN = 0.1  # of the image: how far outside the centre of the subject may lie


def check_face(capture: Capture, samples: Sequence[ViewSample]) -> None:
    """Refuse labelled captures in which no view shows a face. Raises InputError."""
    indices = [capture.classes.index(name) for name in _FACE if name in capture.classes]
    labelled = [sample.labels for sample in samples if sample.labels is not None]
    skin = [capture.classes.index(name) for name in ("skin",) if name in capture.classes]
    shown = any(_shows(labels, skin) for labels in labelled)
    if len(indices) < 2 or not shown or any(_shows(labels, indices) for labels in labelled):
        return
    raise refuse(
        "face-unseen",
        "No view shows the face: all cameras seem to be behind the head",
        where=capture.root / "segmentation",
        expected=f"{listed(_FACE)} in the labels of some views",
        got=f"none in {len(labelled)} label maps",
        fix="add views from the front",
    )


def _shows(labels: np.ndarray, indices: Iterable[int]) -> bool:
    return bool(np.isin(labels, list(indices)).sum() >= _MIN_SAMPLES)


def lens_warnings(capture: Capture) -> list[Finding]:
    """Distortions that show a part of the image twice."""
    names = [view.name for view in capture.views if _folds(view.camera)]
    if not names:
        return []
    line = f"the distortion folds the image over itself: {listed(names)}; check the coefficients"
    return [
        Finding.warning("distortion", f"{line}: k1 k2 p1 p2 [k3 ...] of OpenCV, of the plane z = 1 and not of pixels")
    ]


def _folds(camera: Camera) -> bool:
    """Whether undistortion shows a part of the image twice or mirrored."""
    if not camera.distortion:
        return False
    coarse = camera.scaled(64, 64)
    size = (64, 64)
    x, y = cv2.initUndistortRectifyMap(
        opencv_intrinsics(camera.intrinsics),
        np.array(camera.distortion),
        None,
        opencv_intrinsics(coarse.intrinsics),
        size,
        cv2.CV_32FC1,
    )
    (x_down, x_right), (y_down, y_right) = np.gradient(x), np.gradient(y)
    inside = (x >= 0) & (x <= camera.width_px - 1) & (y >= 0) & (y <= camera.height_px - 1)
    return bool((x_right * y_down - x_down * y_right)[inside].min(initial=1.0) <= 0)


def exposure_warnings(capture: Capture, samples: Sequence[ViewSample]) -> list[Finding]:
    """Views that are much brighter or darker than those beside them, or white where others are not.

    Skin is compared where labels show it: of few views the dark hair of one is not beside that of another.
    """
    greys = [_grey_of_skin(capture, sample) for sample in samples]
    found = [(view, grey) for view, grey in zip(capture.views, greys, strict=True) if grey is not None]
    if len(found) < 2:
        return []
    values = [grey for _, grey in found]
    light = [float(np.median(srgb_to_linear(grey))) if len(grey) else 1.0 for grey in values]
    stops = np.log2(np.array(light) + _BLACK)
    white = np.array([float((grey > _WHITE).mean()) if len(grey) else 0.0 for grey in values])
    axes = np.stack([view.camera.T_cam_world[2, :3] for view, _ in found])
    cosines = axes @ axes.T - 3 * np.eye(len(axes))
    warned = []
    for number, (view, _) in enumerate(found):
        beside = np.argsort(-cosines[number], kind="stable")[:_NEAR_VIEWS][: len(found) - 1]
        differences = stops[number] - np.median(stops[beside]), stops[number] - np.median(stops)
        if min(map(abs, differences)) > _STOPS and differences[0] * differences[1] > 0:
            warned.append(f"{view.name} ({2 ** differences[1]:.2g} times the light)")
        elif white[number] > _SATURATED and np.median(white) < _FEW_SATURATED:
            warned.append(f"{view.name} ({white[number]:.0%} white)")
    if not warned:
        return []
    line = f"views of another exposure: {listed(warned)}; the fit gives each camera a gain, but white and black pixels "
    return [Finding.warning("exposure", line + "are lost: develop the images alike, or leave these views out")]


def _grey_of_skin(capture: Capture, sample: ViewSample) -> Float[np.ndarray, "P"] | None:
    """The grey values of a view's skin, of the subject without labels; None: no image, or nearly no skin."""
    if sample.grey is None or sample.labels is None or "skin" not in capture.classes:
        return None if sample.grey is None else sample.grey[sample.subject]
    skin = sample.subject & (sample.labels == capture.classes.index("skin"))
    return sample.grey[skin] if skin.sum() > _MIN_SKIN * sample.subject.sum() else None


def unseen_warnings(capture: Capture, centre: Float[np.ndarray, "3"] | None) -> list[Finding]:
    """Cameras that do not see the subject.

    Args:
        capture: the capture.
        centre: of the subject, m, world; None: not known.
    """
    if centre is None:
        return []
    names = []
    for view in capture.views:
        with np.errstate(divide="ignore", invalid="ignore"):
            (xy,), (depth,) = view.camera.project(centre[None])
        place = xy / [view.camera.width_px, view.camera.height_px]
        if not depth > 0 or not (np.abs(place - 0.5) <= 0.5 + _MARGIN).all():
            names.append(view.name)
    if not names:
        return []
    where = ", ".join(f"{value:.2f}" for value in centre)
    line = f"the subject, at ({where}) m, is not in the view of {listed(names)}; check the poses, or remove these views"
    return [Finding.warning("unseen", line)]
