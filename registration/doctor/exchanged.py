"""Views whose files are another view's: found by landmarks and the poses, outlines, and edges of the images."""

from collections import Counter
from collections.abc import Sequence
from itertools import combinations

import cv2
import numpy as np
from jaxtyping import Bool, Float

from registration.capture import triangulation
from registration.capture.samples import ViewSample
from registration.doctor.contradictions import overlap, silhouettes
from registration.doctor.landmark_checks import misread_view
from registration.types import Capture, View

_MIN_POINTS = 6
_CONTRADICTS, _FITS = 0.6, 0.8  # fractions of a view's landmarks
_OWN, _OTHER = 0.85, 0.93  # overlap of two outlines of a view that is none, and of two that belong together
_EDGES = 1.5  # by which the edges at another outline must exceed those at a view's own


def exchanged_views(capture: Capture, samples: Sequence[ViewSample], points: Float[np.ndarray, "L 3"]) -> list[str]:
    """Name views that seem to have each other's files, or the same.

    Args:
        capture: the capture.
        samples: of its views.
        points: triangulated landmarks of scheme 68, metres, world; L = 0 without.

    Returns:
        Warnings.
    """
    pairs = {**_by_edges(samples), **_by_outlines(capture, samples)}  # outlines say more
    return [*views_that_contradict(capture, points), *pairs.values(), *_same_images(samples)]


def views_that_contradict(capture: Capture, points: Float[np.ndarray, "L 3"]) -> list[str]:
    """Name views most of whose landmarks contradict the others, with what would make them agree.

    Args:
        capture: the capture.
        points: triangulated landmarks of scheme 68, metres, world; L = 0 without.
    """
    if len(points) != 68:
        return []
    bad = [view for view in capture.views if (fit := _fit(view, view, points)) is not None and fit < 1 - _CONTRADICTS]
    warnings: list[str] = []
    named: set[str] = set()
    for a, b in combinations(bad, 2):
        if {a.name, b.name} & named:
            continue
        if min(_fit(a, b, points) or 0.0, _fit(b, a, points) or 0.0) > _FITS:
            named |= {a.name, b.name}
            warnings.append(
                f"{a.name} and {b.name} seem exchanged: the landmarks of each fit the other's camera; "
                "check which image belongs to which pose"
            )
    for view in bad:
        if view.name in named:
            continue
        if (reading := misread_view(capture, view, points)) is not None:
            warnings.append(f"{view.name}: its landmarks fit the other views if they are {reading.name}; {reading.fix}")
        else:
            warnings.append(f"{view.name}: most of its landmarks contradict the other views; check its image and pose")
    return warnings


def _fit(view: View, other: View, points: Float[np.ndarray, "68 3"]) -> float | None:
    """Fraction of a view's landmarks that fit the points as seen from another view's camera; None: too few."""
    if "68" not in view.landmarks:
        return None
    moved = View(name=view.name, camera=other.camera, image=view.image, landmarks=view.landmarks)
    residuals = triangulation.residuals(moved, "68", points)
    valid = residuals[np.isfinite(residuals)]
    if len(valid) < _MIN_POINTS:
        return None
    return float(np.mean(valid < 2 * triangulation.inlier_limit_px(other.camera)))


def _by_outlines(capture: Capture, samples: Sequence[ViewSample]) -> dict[tuple[str, str], str]:
    """Pairs of views in which one kind of file fits the other view -> the warning."""
    outlines = [silhouettes(capture, sample) for sample in samples]
    misfits: dict[tuple[str, str], list[str]] = {}
    for first, second in combinations(("masks", "segmentation", "normals"), 2):
        usable = [i for i, outline in enumerate(outlines) if first in outline and second in outline]
        doubtful = [i for i in usable if overlap(outlines[i][first], outlines[i][second]) < _OWN]
        for i, k in combinations(doubtful, 2):
            crossed = [overlap(outlines[a][first], outlines[b][second]) for a, b in ((i, k), (k, i))]
            if min(crossed) > _OTHER:
                misfits.setdefault((samples[i].name, samples[k].name), []).extend((first, second))
    warnings = {}
    for pair, folders in misfits.items():
        (most, _), *_ = Counter(folders).most_common(1)
        where = f"in {most}/" if folders.count(most) > 1 else f"in {' or '.join(dict.fromkeys(folders))}/"
        warnings[pair] = (
            f"the files of {pair[0]} and {pair[1]} seem exchanged {where}: each fits the other view's outline"
        )
    return warnings


def _by_edges(samples: Sequence[ViewSample]) -> dict[tuple[str, str], str]:
    """Pairs of views whose images have edges at each other's outlines, but not at their own -> the warning."""
    used = [sample for sample in samples if sample.grey is not None and 0 < sample.subject.mean() < 1]
    edges = [_edges(sample) for sample in used]
    rims = [_rim(sample.subject) for sample in used]
    table = np.array(
        [[float(e[r].mean()) if e.shape == r.shape and r.any() else np.nan for r in rims] for e in edges]
    ).reshape(len(used), len(used))
    own = np.diag(table)
    warnings = {}
    for i, k in combinations(range(len(used)), 2):
        better = min(table[i, k] / max(own[i], 1e-6), table[k, i] / max(own[k], 1e-6))
        if better > _EDGES and max(own[i], own[k]) < 0.7 * np.nanmedian(own):
            pair = used[i].name, used[k].name
            warnings[pair] = (
                f"the images of {pair[0]} and {pair[1]} seem exchanged: each has edges at the other view's outline; "
                "exchange the two images"
            )
    return warnings


def _edges(sample: ViewSample) -> Float[np.ndarray, "h w"]:
    """Strength of the image's edges, relative to its mean."""
    assert sample.grey is not None
    smooth = cv2.GaussianBlur(sample.grey, (0, 0), 1.0)
    strength = np.hypot(*np.gradient(smooth)).astype(np.float32)
    return strength / max(float(strength.mean()), 1e-6)


def _rim(inside: Bool[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    kernel, mask = np.ones((3, 3), np.uint8), inside.astype(np.uint8)
    rim = cv2.dilate(mask, kernel) != cv2.erode(mask, kernel)
    rim[[0, -1]] = rim[:, [0, -1]] = False
    return rim


def _same_images(samples: Sequence[ViewSample]) -> list[str]:
    seen: dict[bytes, str] = {}
    warnings = []
    for sample in samples:
        if sample.grey is None or sample.grey.std() == 0:
            continue
        other = seen.setdefault(sample.grey.tobytes(), sample.name)
        if other != sample.name:
            warnings.append(f"{other} and {sample.name} have the same image")
    return warnings
