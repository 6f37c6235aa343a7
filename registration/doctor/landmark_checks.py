"""Landmarks in other units, pixels or orders: found from their values and from whether the views agree on them."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from registration.capture import triangulation
from registration.doctor.findings import refuse
from registration.doctor.fixes import LandmarkFix
from registration.types import Camera, Capture, View

# The points of the 68 scheme after left and right are exchanged.
MIRRORED_68 = np.array(
    [*range(16, -1, -1), *range(26, 16, -1), 27, 28, 29, 30, 35, 34, 33, 32, 31, 45, 44, 43, 42, 47, 46]
    + [39, 38, 37, 36, 41, 40, 54, 53, 52, 51, 50, 49, 48, 59, 58, 57, 56, 55, 64, 63, 62, 61, 60, 67, 66, 65]
)
_MAX_CONFIDENCE = 1.5  # some detectors' scores exceed 1 a little
_MIN_POINTS = 6
_TRIED = 16  # landmarks that the readings are tried with
_DOUBTFUL, _SURE = 0.85, 0.8  # fractions of a capture's landmarks that agree
_SCALES = (1 / 8, 1 / 4, 1 / 3, 1 / 2, 2 / 3, 3 / 4, 4 / 3, 3 / 2, 2, 3, 4, 8)
_SIDES_PX = (224, 256, 384, 512, 640, 720, 768, 1024, 1080, 1280, 1920, 2048)  # that detectors resize images to
_MIN_CHIRALITY = 0.1

Points = Float[np.ndarray, "L 3"]


@dataclass(frozen=True, kw_only=True)
class Reading:
    """Another meaning that landmark files may have."""

    kind: str  # of the finding
    name: str
    fix: str
    read: Callable[[Points, Camera], Points]

    def mend(self, scheme: str, views: Sequence[str] | None = None) -> LandmarkFix:
        """The mend of landmarks with this meaning."""
        return LandmarkFix(
            what=f"read landmarks as {self.name}: {self.fix}", change=self.read, schemes=(scheme,), views=views
        )


def check_values(capture: Capture) -> None:
    """Check confidences and coordinates without their geometry.

    Raises:
        InputError: confidences are no fractions, none is above the limit, or coordinates are normalized.
    """
    rows = [(view, points) for view in capture.views for points in view.landmarks.values() if len(points)]
    if not rows:
        return
    where = capture.root / "landmarks"
    confidences = np.concatenate([points[:, 2] for _, points in rows])
    if (highest := confidences.max()) > _MAX_CONFIDENCE:
        flags = bool(np.isin(confidences, (0, 1, 2)).all())
        percent = "divide them by 100, if they are in percent" if highest <= 100 else "scale them to 0 to 1"
        raise refuse(
            "landmarks-confidence",
            "The landmarks' confidences are not between 0 and 1",
            where=where,
            expected=f"0 to 1; points above {triangulation.MIN_CONFIDENCE} are used",
            got="0, 1 and 2, as COCO flags points" if flags else f"up to {highest:g}",
            fix="write 1 for flag 2 and 0 for the others" if flags else percent,
            mend=_confidence_mend(flags, highest),
        )
    if highest <= triangulation.MIN_CONFIDENCE:
        raise refuse(
            "face-unseen",
            "No landmark is used",
            where=where,
            expected=f"confidences above {triangulation.MIN_CONFIDENCE} for points that are seen",
            got=f"no confidence above {highest:g}",
            fix="if all cameras are behind the head, add views of the face; else write the confidences as fractions of "
            "1, or remove the landmarks",
        )
    used = [points[points[:, 2] > triangulation.MIN_CONFIDENCE, :2] for _, points in rows]
    low, high = np.concatenate(used).min(), np.concatenate(used).max()
    smallest = min(min(view.camera.width_px, view.camera.height_px) for view, _ in rows)
    if sum(map(len, used)) >= _MIN_POINTS and low >= -1.5 and high <= 1.5 and smallest > 16:
        raise refuse(
            "landmarks-normalized",
            "The landmarks look normalized",
            where=where,
            expected="pixels of the stored images",
            got=f"coordinates from {low:.3g} to {high:.3g}",
            fix="multiply x by the image's width and y by its height"
            if low >= -0.2
            else "convert them into pixels: (x + 1) / 2 times the width, (y + 1) / 2 times the height",
            mend=_in_pixels(centred=bool(low < -0.2)),
        )


def _confidence_mend(flags: bool, highest: float) -> LandmarkFix | None:
    """COCO's flags, percent or bytes as fractions; None for other scales."""
    scale = next((scale for scale in (100, 255) if 0.5 * scale <= highest <= scale), None)
    if flags:
        what, change = "wrote confidences for COCO's flags", lambda values: np.where(values == 2, 1.0, 0.0)
    elif scale is not None:
        what, change = f"divided confidences by {scale}", lambda values: values / scale
    else:
        return None
    return LandmarkFix(what=what, change=lambda points, _: np.column_stack([points[:, :2], change(points[:, 2])]))


def _in_pixels(*, centred: bool) -> LandmarkFix:
    """Coordinates from 0 to 1, or from -1 to 1, in pixels."""

    def change(points: Points, camera: Camera) -> Points:
        size = np.array([camera.width_px, camera.height_px, 1.0])
        return (points + [1, 1, 0]) * size / [2, 2, 1] if centred else points * size

    return LandmarkFix(what="converted normalized landmarks into pixels", change=change)


def check_coordinates(capture: Capture) -> None:
    """Check that no other reading of the landmarks makes the views agree where they do not as written.

    Raises:
        InputError: there is one: another resolution, exchanged axes, mirrored images.
    """
    for scheme in sorted({name for view in capture.views for name in view.landmarks}):
        given = _agreement(capture, scheme)
        if given is None or given >= _DOUBTFUL:
            continue
        views = [view for view in capture.views if scheme in view.landmarks]
        for reading in _readings(views, scheme):
            agreement = _agreement(_read_again(capture, scheme, reading), scheme)
            if agreement is not None and agreement >= _SURE and agreement > given + 0.25:
                raise refuse(
                    reading.kind,
                    f"The landmarks are {reading.name}",
                    where=capture.root / "landmarks",
                    expected="x to the right and y down from the upper left corner, in pixels of the stored images",
                    got=f"{given:.0%} of the landmarks of scheme {scheme} agree as written, {agreement:.0%} if they are"
                    f" {reading.name}",
                    fix=reading.fix,
                    mend=reading.mend(scheme),
                )


def check_chirality(capture: Capture, points: Points) -> None:
    """Check that the triangulated points of the 68 scheme are a face and not its mirror image. Raises InputError."""
    if len(points) != 68 or (handedness := _handedness(points)) is None or handedness > -_MIN_CHIRALITY:
        return
    raise refuse(
        "landmarks-swapped",
        "Left and right of the landmarks are exchanged",
        where=capture.root / "landmarks",
        expected="points 0 and 36 at the subject's right, 16 and 45 at the left, in scheme 68",
        got="the mirror image of a face",
        fix="exchange the points of both sides, as from a detector that ran on mirrored images",
        mend=LandmarkFix(
            what="exchanged the landmarks of both sides", change=lambda points, _: points[MIRRORED_68], schemes=("68",)
        ),
    )


def unnamed_schemes(capture: Capture) -> list[str]:
    """Warn of schemes of 68 points that have another name than 68, if none is named so."""
    schemes = {name: points for view in capture.views for name, points in view.landmarks.items()}
    alike = [name for name, points in schemes.items() if len(points) == 68]
    if "68" in schemes or not alike:
        return []
    return [f"the landmarks of scheme {alike[0]} are 68 points, as those of scheme 68; if they are the same, rename it"]


def misread_view(capture: Capture, view: View, points: Points) -> Reading | None:
    """Return the reading with which one view's landmarks of scheme 68 fit the other views, if one does.

    Args:
        capture: the capture.
        view: one whose landmarks contradict the others.
        points: triangulated from the others, metres, world.
    """
    for reading in _readings([view], "68"):
        changed = _read_again(replace(capture, views=(view,)), "68", reading).views[0]
        residuals = triangulation.residuals(changed, "68", points)
        valid = residuals[np.isfinite(residuals)]
        if len(valid) >= _MIN_POINTS and np.mean(valid < triangulation.inlier_limit_px(view.camera)) > _SURE:
            return reading
    return None


def _readings(views: Sequence[View], scheme: str) -> Iterator[Reading]:
    yield Reading(
        kind="landmarks-axes",
        name="with x and y exchanged",
        fix="write [x_px, y_px, confidence]",
        read=lambda points, _: points[:, [1, 0, 2]],
    )
    yield Reading(
        kind="landmarks-axes",
        name="with y from the lower edge",
        fix="write the image's height minus y",
        read=lambda points, camera: np.array([0, camera.height_px, 0]) + points * [1, -1, 1],
    )
    mirrored = Reading(
        kind="landmarks-mirrored",
        name="in mirrored images",
        fix="write the image's width minus x",
        read=lambda points, camera: np.array([camera.width_px, 0, 0]) + points * [-1, 1, 1],
    )
    yield mirrored
    if scheme == "68":
        yield Reading(
            kind="landmarks-mirrored",
            name="in mirrored images, with left and right exchanged",
            fix="write the image's width minus x, and exchange the points of both sides",
            read=lambda points, camera: mirrored.read(points, camera)[MIRRORED_68],
        )
        yield Reading(
            kind="landmarks-swapped",
            name="with left and right exchanged",
            fix="exchange the points of both sides",
            read=lambda points, _: points[MIRRORED_68],
        )
    yield _resized("100 x 100: percent", lambda camera: 100 / np.array([camera.width_px, camera.height_px]))
    for scale in _SCALES:
        yield Reading(
            kind="landmarks-resolution",
            name=f"in pixels of images of {scale:.3g} times the size",
            fix=f"divide x and y by {scale:.3g}",
            read=lambda points, _, scale=scale: points * [1 / scale, 1 / scale, 1],  # type: ignore[misc]
        )
    for side in _SIDES_PX:
        if all(max(view.camera.width_px, view.camera.height_px) != side for view in views):
            yield _resized(f"longer side {side} px", lambda camera, side=side: np.full(2, side / _longer(camera)))  # type: ignore[misc]
        yield _resized(
            f"{side} x {side} px",
            lambda camera, side=side: side / np.array([camera.width_px, camera.height_px]),  # type: ignore[misc]
        )


def _longer(camera: Camera) -> int:
    return max(camera.width_px, camera.height_px)


def _resized(size: str, scale: Callable[[Camera], Float[np.ndarray, "2"]]) -> Reading:
    return Reading(
        kind="landmarks-resolution",
        name=f"in pixels of images resized to {size}",
        fix="scale x and y back to the size of the stored images",
        read=lambda points, camera: points / [*scale(camera), 1],
    )


def _read_again(capture: Capture, scheme: str, reading: Reading) -> Capture:
    views = []
    for view in capture.views:
        if scheme in view.landmarks:
            changed = reading.read(view.landmarks[scheme], view.camera)
            view = replace(view, landmarks={**view.landmarks, scheme: changed}, landmark_spread_px={})
        views.append(view)
    return replace(capture, views=tuple(views))


def _agreement(capture: Capture, scheme: str) -> float | None:
    """Fraction of the observations of some landmarks that fit the triangulated points; None: too few are compared."""
    views = [view for view in capture.views if scheme in view.landmarks]
    used = np.stack([view.landmarks[scheme][:, 2] > triangulation.MIN_CONFIDENCE for view in views])
    several = np.flatnonzero(used.sum(0) >= 2)
    if len(several) < _MIN_POINTS:
        return None
    tried = several[np.unique(np.linspace(0, len(several) - 1, _TRIED).astype(int))]
    some = tuple(
        replace(view, landmarks={scheme: view.landmarks[scheme][tried]}, landmark_spread_px={}) for view in views
    )
    return float(triangulation.triangulate(replace(capture, views=some), scheme)[1].sum() / used[:, tried].sum())


def _handedness(points: Points) -> float | None:
    """1 for a face, -1 for its mirror image, less for points in a plane; None: points are missing."""
    left = points[45] - points[36]
    up = points[27] - points[33]
    ends = points[[0, 16]] if np.isfinite(points[[0, 16]]).all() else points[[36, 45]]
    forward = points[33] - ends.mean(0)
    axes = np.stack([left, up, forward])
    lengths = np.linalg.norm(axes, axis=-1)
    if not np.isfinite(axes).all() or not (lengths > 0).all():
        return None
    return float(np.linalg.det(axes / lengths[:, None]))
