"""Files of one view that contradict one another: inverted masks, exchanged eyes, labels of another image."""

from collections.abc import Iterator, Sequence

import cv2
import numpy as np
from jaxtyping import Bool, Float

from registration.capture.class_names import BACKGROUND
from registration.capture.samples import ViewSample
from registration.capture.text import listed
from registration.capture.triangulation import MIN_CONFIDENCE
from registration.errors import InputError
from registration.types import Capture, View

_MIN_POINTS, _MIN_SAMPLES = 6, 3
_MOST, _FEW = 0.7, 0.3
_TOLERANCE = 0.02  # of the image's height: distance from the mask at which a landmark still lies in it
_NEARER = 0.5  # times the distance as named: exchanged
_DARK, _FLAT = 0.01, 0.004  # mean and deviation of an image's grey values, of 1
# Two classes, and points of the 68 scheme on each.
_PAIRS = (
    ("left_eye", range(42, 48), "right_eye", range(36, 42)),
    ("upper_lip", (50, 51, 52, 61, 62, 63), "lower_lip", (56, 57, 58, 65, 66, 67)),
)


def check_views(capture: Capture, samples: Sequence[ViewSample]) -> list[str]:
    """Compare masks, labels, landmarks and images within each view.

    Returns:
        Warnings.

    Raises:
        InputError: a mask is inverted, or the labels of eyes or lips are exchanged in most views.
    """
    warnings = []
    for view, sample in zip(capture.views, samples, strict=True):
        if sample.mask is not None:
            warnings += _mask_warnings(capture, view, sample)
        if sample.grey is not None:
            warnings += _image_warnings(sample)
    return warnings + _exchanged_classes(capture, samples)


def _mask_warnings(capture: Capture, view: View, sample: ViewSample) -> list[str]:
    assert sample.mask is not None
    inside, hits = sample.mask > 127, landmarks_inside(view, sample)
    overlap = None
    if sample.labels is not None and BACKGROUND in capture.classes:
        labelled = sample.labels != capture.classes.index(BACKGROUND)
        overlap = float((labelled == inside).mean())
    border = float(np.concatenate([inside[0], inside[:, 0], inside[:, -1]]).mean())  # a bust touches the lower one
    height, width = inside.shape
    centre = float(inside[height // 4 : -height // 4, width // 4 : -width // 4].mean())
    if overlap is not None:
        inverted = overlap < _FEW
    elif hits is not None:
        inverted = hits < _FEW and border > 0.5
    else:
        inverted = border > 0.8 and centre < 0.2
    if inverted:
        evidence = (
            f"{overlap:.0%} of the pixels agree with the labels"
            if overlap is not None
            else f"{border:.0%} of the border and {centre:.0%} of the centre in the mask"
        )
        raise InputError(
            "The mask is inverted",
            where=view.mask,
            expected="255 where the subject is, 0 elsewhere",
            got=evidence if hits is None else f"{evidence}; {hits:.0%} of the landmarks lie in it",
            fix="invert the mask",
        )
    warnings = []
    if overlap is not None and overlap < _MOST:
        warnings.append(
            f"{sample.name}: mask and labels show the subject in different places, {overlap:.0%} of the pixels agree"
        )
    if hits is not None and hits < 0.5:
        warnings.append(
            f"{sample.name}: only {hits:.0%} of its landmarks lie in its mask; check which is another image's"
        )
    if inside.all():
        warnings.append(f"{sample.name}: the mask covers the whole image; check that it is a mask")
    return warnings


def landmarks_inside(view: View, sample: ViewSample) -> float | None:
    """Fraction of a view's landmarks that lie in its mask or near it; None: it has too few."""
    used = [points[points[:, 2] > MIN_CONFIDENCE, :2] for points in view.landmarks.values()]
    points = np.concatenate([np.zeros((0, 2)), *used])
    if len(points) < _MIN_POINTS or sample.mask is None:
        return None
    reach = 2 * int(np.ceil(_TOLERANCE * sample.mask.shape[0])) + 1
    near = cv2.dilate((sample.mask > 127).astype(np.uint8), np.ones((reach, reach), np.uint8)).astype(bool)
    return float(near[sample.at(points)].mean())


def _image_warnings(sample: ViewSample) -> list[str]:
    assert sample.grey is not None
    values = sample.grey[sample.subject] if sample.subject.any() else sample.grey
    if values.mean() < _DARK:
        return [f"{sample.name}: the image is black where the subject is"]
    if sample.grey.std() < _FLAT:
        return [f"{sample.name}: the image shows nothing, it has one brightness"]
    return []


def _exchanged_classes(capture: Capture, samples: Sequence[ViewSample]) -> list[str]:
    warnings = []
    for first, first_points, second, second_points in _PAIRS:
        if first not in capture.classes or second not in capture.classes:
            continue
        verdicts = {}
        for view, sample in zip(capture.views, samples, strict=True):
            centres = [c for name in (first, second) if (c := _centre(sample, capture.classes.index(name))) is not None]
            marks = [m for points in (first_points, second_points) if (m := _mean_landmark(view, points)) is not None]
            if len(centres) < 2:
                continue
            verdict = _crossed(centres, marks) if len(marks) == 2 else None
            if verdict is None and first == "left_eye":
                verdict = _mirrored(centres, list(_lips(capture, sample)))
            if verdict is not None:
                verdicts[view.name] = verdict
        exchanged = [name for name, verdict in verdicts.items() if verdict]
        if len(exchanged) > len(verdicts) / 2 and (len(exchanged) > 1 or len(capture.views) == 2):
            raise InputError(
                f"The labels {first} and {second} are exchanged",
                where=capture.root / "segmentation",
                expected=f"{first} where the landmarks show it; left is the subject's left",
                got=f"it lies at the {second} in {len(exchanged)} of {len(verdicts)} views: {listed(exchanged, 5)}",
                fix=f"exchange {first} and {second} in [segmentation] classes of capture.toml",
            )
        warnings += [f"{name}: the labels {first} and {second} are exchanged" for name in exchanged]
    return warnings


def _crossed(centres: Sequence[Float[np.ndarray, "2"]], marks: Sequence[Float[np.ndarray, "2"]]) -> bool | None:
    """Whether two labels lie at each other's landmarks; None: not clear."""

    def distance(order: Sequence[int]) -> float:
        return float(sum(np.linalg.norm(centres[i] - marks[k]) for i, k in enumerate(order)))

    straight, crossed = distance((0, 1)), distance((1, 0))
    if min(straight, crossed) > _NEARER * max(straight, crossed):
        return None
    return crossed < straight


def _mirrored(eyes: Sequence[Float[np.ndarray, "2"]], lips: Sequence[Float[np.ndarray, "2"]]) -> bool | None:
    """Whether the left eye lies where a face has the right one, as seen from the front; None: not clear."""
    if not lips:
        return None
    across, down = eyes[0] - eyes[1], np.mean(lips, axis=0) - np.mean(eyes, axis=0)
    sine = (across[0] * down[1] - across[1] * down[0]) / max(np.linalg.norm(across) * np.linalg.norm(down), 1e-9)
    return None if abs(sine) < 0.5 else bool(sine < 0)


def _lips(capture: Capture, sample: ViewSample) -> Iterator[Float[np.ndarray, "2"]]:
    for name in ("upper_lip", "lower_lip"):
        if name in capture.classes and (centre := _centre(sample, capture.classes.index(name))) is not None:
            yield centre


def _centre(sample: ViewSample, index: int) -> Float[np.ndarray, "2"] | None:
    """The centre of a class in px of the stored image; None: it is not there."""
    if sample.labels is None:
        return None
    rows, columns = np.nonzero(sample.labels == index)
    if len(rows) < _MIN_SAMPLES:
        return None
    return (np.array([columns.mean(), rows.mean()]) + 0.5) * sample.step


def _mean_landmark(view: View, indices: Sequence[int] | range) -> Float[np.ndarray, "2"] | None:
    """The mean of the points of the 68 scheme that are seen; None: fewer than half."""
    points = view.landmarks.get("68", np.zeros((0, 3)))
    if len(points) != 68:
        return None
    points = points[list(indices)]
    seen = points[points[:, 2] > MIN_CONFIDENCE]
    return seen[:, :2].mean(0) if 2 * len(seen) >= len(points) else None


def silhouettes(capture: Capture, sample: ViewSample) -> dict[str, Bool[np.ndarray, "h w"]]:
    """What each channel of a view shows of the subject: masks, labels and normals."""
    found = {}
    if sample.mask is not None:
        found["masks"] = sample.mask > 127
    if sample.labels is not None and BACKGROUND in capture.classes:
        found["segmentation"] = sample.labels != capture.classes.index(BACKGROUND)
    if sample.normals is not None:
        found["normals"] = (sample.normals != 0).any(-1)
    return found
