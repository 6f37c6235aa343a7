"""Files of one view that contradict one another: inverted masks, exchanged eyes, labels of another image."""

from collections.abc import Iterator, Sequence

import cv2
import numpy as np
from jaxtyping import Bool, Float

from registration.capture import label_maps
from registration.capture.class_names import BACKGROUND, KNOWN
from registration.capture.samples import ViewSample
from registration.capture.text import listed
from registration.capture.triangulation import MIN_CONFIDENCE
from registration.doctor.findings import Finding, FindingError, refuse, warnings
from registration.doctor.fixes import ClassFix, MaskFix
from registration.types import Capture, View

_MIN_POINTS, _MIN_SAMPLES = 6, 3
_MOST, _FEW = 0.7, 0.3
_TOLERANCE = 0.02  # of the image's height: distance from the mask at which a landmark still lies in it
_FAR = 0.35  # times the distance of two landmarks: not there
_NEARER = 0.5  # times the distance as named: exchanged
_DARK, _FLAT = 0.01, 0.004  # mean and deviation of an image's grey values, of 1
# Two classes, and points of the 68 scheme on each.
_PAIRS = (
    ("left_eye", range(42, 48), "right_eye", range(36, 42)),
    ("upper_lip", (50, 51, 52, 61, 62, 63), "lower_lip", (56, 57, 58, 65, 66, 67)),
)


def check_labels(capture: Capture, samples: Sequence[ViewSample]) -> None:
    """Refuse labels whose names contradict masks or landmarks.

    Raises:
        InputError: the classes are in another order, or those of eyes or lips are exchanged in most views.
    """
    _check_label_order(capture, samples)
    _exchanged_classes(capture, samples)


def view_warnings(capture: Capture, samples: Sequence[ViewSample]) -> list[Finding]:
    """Compare masks, labels, landmarks and images within each view."""
    found: dict[tuple[str, str], list[str]] = {}  # kind, what -> views
    for view, sample in zip(capture.views, samples, strict=True):
        for kind, what in [*_mask_warnings(capture, view, sample), *_image_warnings(sample)]:
            found.setdefault((kind, what), []).append(view.name)
    lines = [Finding.warning(kind, f"{what}: {listed(names)}") for (kind, what), names in found.items()]
    try:
        return lines + warnings("labels-swapped", _exchanged_classes(capture, samples))
    except FindingError:  # `check_labels` refused them
        return lines


def check_inverted(capture: Capture, samples: Sequence[ViewSample]) -> None:
    """Refuse masks that are inverted. Raises InputError."""
    found = {
        view.name: got
        for view, sample in zip(capture.views, samples, strict=True)
        if sample.mask is not None and (got := _inverted(capture, view, sample)) is not None
    }
    if not found:
        return
    masked = [sample for sample in samples if sample.mask is not None]
    if 2 * len(found) > len(masked):  # then so are others whose border is white
        found |= {
            s.name: "most of the border is in the mask" for s in masked if s.name not in found and _border(s) > _MOST
        }
    names = list(found)
    first = next(view for view in capture.views if view.name in found)
    raise refuse(
        "mask-inverted",
        "The mask is inverted",
        where=first.mask if len(names) == 1 else capture.root / "masks",
        expected="255 where the subject is, 0 elsewhere",
        got=found[names[0]]
        if len(names) == 1
        else f"{len(names)} masks, {listed(names, 5)}; in {names[0]} {found[names[0]]}",
        fix="invert the mask" if len(names) == 1 else "invert the masks",
        mend=MaskFix(what=f"inverted {len(names)} masks: {listed(names, 5)}", views=names),
    )


def _inverted(capture: Capture, view: View, sample: ViewSample) -> str | None:
    """What shows that a view's mask is inverted; None if it is not."""
    assert sample.mask is not None
    inside, hits = sample.mask > 127, landmarks_inside(view, sample)
    border = _border(sample)
    height, width = inside.shape
    centre = float(inside[height // 4 : -height // 4, width // 4 : -width // 4].mean())
    got = f"{100 * border:.0f} % of the border and {100 * centre:.0f} % of the centre in the mask"
    if sample.labels is not None and BACKGROUND in capture.classes:
        agreement = float((inside == (sample.labels != capture.classes.index(BACKGROUND))).mean())
        inverted = agreement < _FEW and border > _MOST
        got += f"; {100 * agreement:.0f} % of the pixels agree with the labels"
    elif hits is not None:
        inverted = hits < _FEW and border > _MOST
        got += f"; {100 * hits:.0f} % of the landmarks lie in it"
    else:
        inverted = border > 0.8 and centre < 0.2
    return got if inverted else None


def _border(sample: ViewSample) -> float:
    """The share of the image's border that is in the mask, but for the lower one, which a bust touches."""
    assert sample.mask is not None
    inside = sample.mask > 127
    return float(np.concatenate([inside[0], inside[:, 0], inside[:, -1]]).mean())


def check_landmarks_inside(capture: Capture, samples: Sequence[ViewSample]) -> None:
    """Refuse landmarks most of which lie outside the masks in most views. Raises InputError."""
    shares = {
        view.name: inside
        for view, sample in zip(capture.views, samples, strict=True)
        if sample.mask is not None and (inside := landmarks_inside(view, sample)) is not None
    }
    outside = [name for name, inside in shares.items() if inside < 0.5]
    if len(outside) < 2 or 3 * len(outside) <= 2 * len(shares):
        return
    raise refuse(
        "landmarks-outside",
        f"The landmarks lie outside the masks: {listed(outside, 5)}",
        where=capture.root / "landmarks",
        expected="landmarks of the subject that the masks show, in pixels of the stored images",
        got=f"{100 * shares[outside[0]]:.0f} % of those of {outside[0]} in its mask",
        fix="check that landmarks and masks belong to these images and to their size: detectors report pixels of a "
        "crop or of a resized image",
    )


def _mask_warnings(capture: Capture, view: View, sample: ViewSample) -> Iterator[tuple[str, str]]:
    if sample.mask is None:
        return
    if (sample.mask > 127).all():
        yield "mask-values", "the mask covers the whole image; check that it is a mask"
        return
    hits, outlines = landmarks_inside(view, sample), silhouettes(capture, sample)
    if "segmentation" in outlines and overlap(outlines["masks"], outlines["segmentation"]) < _MOST:
        yield "views-exchanged", "mask and labels show the subject in different places; check which is another image's"
    if "normals" in outlines and (outlines["normals"] & ~outlines["masks"]).sum() > 0.5 * outlines["normals"].sum():
        if not outlines["normals"].all():
            yield "views-exchanged", "most normals lie outside the mask; check which is another image's"
    if hits is not None and hits < 0.5:
        yield "landmarks-outside", "most landmarks lie outside the mask; check which is another image's"


def _check_label_order(capture: Capture, samples: Sequence[ViewSample]) -> None:
    """Compare the classes inside and outside all masks. Raises InputError if they are clearly others' names."""
    counts = np.zeros((2, len(capture.classes)), int)
    for sample in samples:
        if sample.mask is not None and sample.labels is not None and not (sample.mask > 127).all():
            for row, where in enumerate((sample.mask <= 127, sample.mask > 127)):
                counts[row] += np.bincount(sample.labels[where], minlength=len(capture.classes))
    if not counts.sum(1).all():
        return
    outside = capture.classes[int(counts[0].argmax())]
    share = counts[0].max() / counts[0].sum()
    moved = BACKGROUND in capture.classes and outside != BACKGROUND
    if moved:
        behind = counts[:, capture.classes.index(BACKGROUND)]
        moved = behind[1] > _MOST * behind.sum() > 0
    named = outside in KNOWN and outside != BACKGROUND and counts[0, counts[0].argmax()] > counts[1, counts[0].argmax()]
    if share > _MOST and (moved or named):
        fits = label_maps.fitting_tables(capture.views)
        looks = f'; the maps look like those of {" or ".join(fits)}: write table = "{fits[0]}"' if fits else ""
        raise refuse(
            "labels-order",
            "The labels' classes are in another order, or the background has no name",
            where=capture.root / "capture.toml",
            expected="background outside the masks",
            got=f"{outside} at {100 * share:.0f} % of the pixels outside the masks",
            fix=f"check that classes[k] of [segmentation] is the name of index k, from 0 on{looks}",
        )


def landmarks_inside(view: View, sample: ViewSample) -> float | None:
    """Fraction of a view's landmarks that lie in its mask or near it; None: it has too few."""
    used = [points[points[:, 2] > MIN_CONFIDENCE, :2] for points in view.landmarks.values()]
    points = np.concatenate([np.zeros((0, 2)), *used])
    if len(points) < _MIN_POINTS or sample.mask is None:
        return None
    reach = 2 * int(np.ceil(_TOLERANCE * sample.mask.shape[0])) + 1
    near = cv2.dilate((sample.mask > 127).astype(np.uint8), np.ones((reach, reach), np.uint8)).astype(bool)
    return float(near[sample.at(points)].mean())


def _image_warnings(sample: ViewSample) -> Iterator[tuple[str, str]]:
    if sample.grey is None:
        return
    values = sample.grey[sample.subject] if sample.subject.any() else sample.grey
    if values.mean() < _DARK:
        yield "exposure", "the image is black where the subject is"
    elif sample.grey.std() < _FLAT:
        yield "exposure", "the image shows nothing, it has one brightness"


def _exchanged_classes(capture: Capture, samples: Sequence[ViewSample]) -> list[str]:
    lines: list[str] = []
    apart: list[str] = []
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
            if len(marks) == 2 and first == "left_eye" and _apart(centres, marks):
                apart.append(view.name)
            if verdict is None and first == "left_eye":
                verdict = _mirrored(centres, list(_lips(capture, sample)))
            if verdict is not None:
                verdicts[view.name] = verdict
        exchanged = [name for name, verdict in verdicts.items() if verdict]
        if len(exchanged) > len(verdicts) / 2 and (len(exchanged) > 1 or len(capture.views) == 2):
            side = ', or write left = "image" there ("subject" if it was)' if first == "left_eye" else ""
            raise refuse(
                "labels-swapped",
                f"The labels {first} and {second} are exchanged",
                where=capture.root / "segmentation",
                expected=f"{first} where the landmarks show it; left is the subject's left",
                got=f"it lies at the {second} in {len(exchanged)} of {len(verdicts)} views: {listed(exchanged, 5)}",
                fix=f"exchange {first} and {second} in [segmentation] classes of capture.toml{side}",
                mend=ClassFix(what=f"exchanged the names of {first} and {second}", first=first, second=second),
            )
        if exchanged:
            lines.append(f"{first} and {second} are exchanged in labels or landmarks: {listed(exchanged)}")
    if apart:
        lines.append(f"labels and landmarks show the eyes in different places: {listed(apart)}")
    return lines


def _crossed(centres: Sequence[Float[np.ndarray, "2"]], marks: Sequence[Float[np.ndarray, "2"]]) -> bool | None:
    """Whether two labels lie at each other's landmarks; None: not clear."""

    def distance(order: Sequence[int]) -> float:
        return float(sum(np.linalg.norm(centres[i] - marks[k]) for i, k in enumerate(order)))

    straight, crossed = distance((0, 1)), distance((1, 0))
    if min(straight, crossed) > _NEARER * max(straight, crossed):
        return None
    return crossed < straight


def _apart(centres: Sequence[Float[np.ndarray, "2"]], marks: Sequence[Float[np.ndarray, "2"]]) -> bool:
    """Whether both labels lie far from both landmarks, in any order."""
    reach = _FAR * np.linalg.norm(marks[0] - marks[1])
    return all(min(np.linalg.norm(centre - mark) for mark in marks) > reach for centre in centres)


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


def overlap(a: Bool[np.ndarray, "h w"], b: Bool[np.ndarray, "h2 w2"]) -> float:
    """Intersection over union of two regions; 0 for images of different size."""
    if a.shape != b.shape:
        return 0.0
    return float((a & b).sum() / max((a | b).sum(), 1))
