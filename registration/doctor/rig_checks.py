"""Checks that the cameras of a capture look at one subject of a head's size; where they do not, the edit that mends it.

Poses of other conventions are rigid motions too, so only what the cameras see tells them apart: landmarks that
triangulate, or masks whose rays meet in front of the cameras. Each of `MISREADINGS` is tried, and the one with which
the views agree is named.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import cv2
import numpy as np
from jaxtyping import Bool, Float

from registration.capture.triangulation import MIN_CONFIDENCE, triangulate
from registration.doctor.conventions import MISREADINGS, Misreading, Witness, agreements
from registration.doctor.findings import Finding, FindingError, refuse
from registration.doctor.fixes import CameraFix
from registration.doctor.length_units import wrong_unit
from registration.types import Camera, Capture

SUBJECT_M = (0.04, 2.5)  # what masks show, its longer side: from a part of a child's face to a whole adult
LANDMARKS_M = (0.01, 2.5)  # the extent of a scheme's landmarks
HEAD_M, _FACE_M = (0.15, 0.5), (0.06, 0.25)  # a head with its neck, and landmarks on it: name the unit
_DOUBTFUL, _BETTER, _CONFIRMED = 0.85, 0.25, 0.5  # fractions of landmark observations that fit
_MEETING = 0.6  # fraction of views in which the point where the rays meet must lie in the mask
_MIN_LANDMARKS, _TRIED_LANDMARKS = 6, 24
_MARGIN = 0.5  # around a mask's box, in sides of the box
_TRIM = 0.005  # of a mask's pixels at each side, outside the box: specks
_MAX_PAIRS = 400
_SAME_PLACE_M = 1e-6
_FAR_M = 1e4


@dataclass(frozen=True, kw_only=True)
class MaskBox:
    """Where a view's mask lies, px of the stored image."""

    low: Float[np.ndarray, "2"]
    high: Float[np.ndarray, "2"]


def mask_box(inside: Bool[np.ndarray, "H W"]) -> MaskBox | None:
    """Return the box of a mask's pixels, without specks; None if there are none."""
    if not inside.any():
        return None
    ends = []
    for counts in (inside.sum(0), inside.sum(1)):
        share = np.cumsum(counts) / counts.sum()
        ends.append((np.searchsorted(share, _TRIM, "right"), np.searchsorted(share, 1 - _TRIM, "left") + 1))
    return MaskBox(low=np.array([ends[0][0], ends[1][0]], float), high=np.array([ends[0][1], ends[1][1]], float))


def check_landmark_rays(capture: Capture) -> bool:
    """Check that landmarks of the views agree on points in front of the cameras.

    Returns:
        Whether they agree; False also where there are too few, or where no convention of poses makes them agree.

    Raises:
        InputError: they agree only if the poses are read in another convention, or all cameras are in one place.
    """
    centres = np.stack([view.camera.centre for view in capture.views])
    if np.ptp(centres, axis=0).max() < _SAME_PLACE_M:
        raise refuse(
            "poses",
            "All cameras are in one place",
            where=capture.root / "sparse",
            expected="cameras that see the subject from several sides",
            got=f"{len(centres)} cameras at {np.round(centres[0], 4).tolist()}",
            fix="write each image's translation into the COLMAP model",
        )
    if (witness := LandmarkWitness.of(capture)) is None:
        return False
    scheme = witness.scheme
    given = _agreement(capture, scheme)
    if given is None or given >= _DOUBTFUL:
        return given is not None
    best, misreading = max(
        ((_agreement(_mended(capture, misreading), scheme) or 0.0, misreading) for misreading in MISREADINGS),
        key=lambda pair: pair[0],
    )
    if best >= max(_DOUBTFUL, given + _BETTER):
        expected = f"landmarks of scheme {scheme} that agree on points in front of the cameras"
        points = triangulate(_mended(capture, misreading), scheme)[0]
        centre = np.nanmedian(points, axis=0)[None]
        behind = all(view.camera.project(centre)[1][0] < 0 for view in capture.views)
        got = "the subject is behind all cameras" if behind else f"{100 * given:.0f} % of the landmarks agree"
        raise wrong_poses(capture, expected, got, misreading)
    _check_digits(capture, given)
    return given >= _CONFIRMED


@dataclass(frozen=True, kw_only=True)
class LandmarkWitness:
    """The agreement of the views on the points that their landmarks show."""

    capture: Capture
    scheme: str
    sure: float = _DOUBTFUL
    better: float = _BETTER

    @classmethod
    def of(cls, capture: Capture) -> "LandmarkWitness | None":
        """The witness of a capture; None if too few landmarks are seen by two views."""
        counts: dict[str, int] = {}
        for view in capture.views:
            for name, points in view.landmarks.items():
                counts[name] = counts.get(name, 0) + int((points[:, 2] > MIN_CONFIDENCE).sum())
        if not counts:
            return None
        scheme = "68" if counts.get("68") else max(counts, key=lambda name: counts[name])
        return None if _agreement(capture, scheme) is None else cls(capture=capture, scheme=scheme)

    def __call__(self, cameras: Sequence[Camera]) -> float:
        """The share of observations that fit the triangulated points."""
        views = tuple(replace(v, camera=camera) for v, camera in zip(self.capture.views, cameras, strict=True))
        return _agreement(replace(self.capture, views=views), self.scheme) or 0.0


def check_poses(capture: Capture, witness: Witness) -> None:
    """Refuse poses of another convention, in which the views agree much better. Raises InputError."""
    cameras = [view.camera for view in capture.views]
    (given, _), *others = agreements(cameras, witness)
    best, misreading = max(others, key=lambda pair: pair[0])
    if best >= max(witness.sure, given + witness.better):
        expected = "views that agree on the colours, labels and normals of the subject's surface"
        got = f"an agreement of {given:.2f}, against {best:.2f}"
        if misreading is not None and _all_behind(cameras, [misreading.camera(camera) for camera in cameras]):
            got = "the subject is behind all cameras"
        raise wrong_poses(capture, expected, got, misreading)


def _all_behind(cameras: Sequence[Camera], mended: Sequence[Camera]) -> bool:
    """Whether the point that the mended cameras look at is behind all cameras as they are written."""
    across = np.stack([np.eye(3) - np.outer(axis, axis) for axis in (camera.T_cam_world[2, :3] for camera in mended)])
    centres = np.stack([camera.centre for camera in mended])
    point = np.linalg.lstsq(across.sum(0), np.einsum("nij,nj->i", across, centres), rcond=None)[0]
    return all(camera.project(point[None])[1][0] < 0 for camera in cameras)


def _check_digits(capture: Capture, agreement: float) -> None:
    """Refuse a far world whose poses do not agree: a rotation's rounding moves a camera by its part of the distance."""
    far = _distance(capture)
    if far > _FAR_M and agreement < _CONFIRMED:
        raise refuse(
            "poses",
            "The poses have too few digits for a world so far from its origin",
            where=capture.root / "sparse",
            expected=f"landmarks that agree, of cameras {far:.3g} m from the world's origin",
            got=f"{100 * agreement:.0f} % that agree",
            fix="write all 17 digits of quaternions and translations, or move the world's origin near the subject",
        )


def _distance(capture: Capture) -> float:
    """The farthest camera's distance (m) from the world's origin."""
    return max(float(np.linalg.norm(view.camera.centre)) for view in capture.views)


def _mended(capture: Capture, misreading: Misreading) -> Capture:
    return replace(capture, views=tuple(replace(view, camera=misreading.camera(view.camera)) for view in capture.views))


def _agreement(capture: Capture, scheme: str) -> float | None:
    """Fraction of some landmarks' observations that fit the triangulated points; None: too few are in several views."""
    views = [view for view in capture.views if scheme in view.landmarks]
    used = np.stack([view.landmarks[scheme][:, 2] > MIN_CONFIDENCE for view in views])
    several = np.flatnonzero(used.sum(0) >= 2)
    if len(several) < _MIN_LANDMARKS:
        return None
    tried = several[np.unique(np.linspace(0, len(several) - 1, _TRIED_LANDMARKS).astype(int))]
    some = tuple(
        replace(view, landmarks={scheme: view.landmarks[scheme][tried]}, landmark_spread_px={}) for view in views
    )
    return float(triangulate(replace(capture, views=some), scheme)[1].sum() / used[:, tried].sum())


def check_mask_rays(capture: Capture, boxes: Mapping[str, MaskBox | None], *, poses: bool, size: bool) -> None:
    """Check that the masks' rays meet in front of the cameras, in a subject of a person's size.

    Args:
        capture: with calibrated views.
        boxes: view's name -> the box of its mask; None: it has none.
        poses: check whether they meet.
        size: check the size of what they show.

    Raises:
        InputError: they do not meet, or they do and the masks show nothing of a person's size.
    """
    pairs = [(view.camera, box) for view in capture.views if (box := boxes.get(view.name)) is not None]
    if len(pairs) < 2:
        return
    cameras = [camera for camera, _ in pairs]
    ends = np.stack([undistorted_box(camera, box) for camera, box in pairs])
    given = meeting(cameras, ends)
    needed = max(2, math.ceil(_MEETING * len(pairs)))
    if poses and given.hits < needed:
        tried = [(meeting([m.camera(camera) for camera in cameras], ends), m) for m in MISREADINGS]
        best, misreading = max(tried, key=lambda pair: (pair[0].hits, -pair[0].miss))
        seen = f"{len(pairs) - given.hits} of {len(pairs)} cameras do not see the point that most rays pass"
        behind = given.behind == len(pairs)
        got = "the subject is behind all cameras" if behind else seen
        expected = "rays through the masks' centres that nearly meet, in front of all cameras"
        raise wrong_poses(capture, expected, got, misreading if best.hits >= needed else None)
    extent = subject_extent(capture, boxes) if size and given.hits >= needed else None
    if extent is not None:
        check_extent(capture, "masks", extent, SUBJECT_M, HEAD_M)


def subject_extent(capture: Capture, boxes: Mapping[str, MaskBox | None]) -> float | None:
    """The longer side (m) of what boxes show, in the median of the views; None: their rays do not meet, or are cut."""
    pairs = [(view.camera, box) for view in capture.views if (box := boxes.get(view.name)) is not None]
    if len(pairs) < 2:
        return None
    met = meeting([camera for camera, _ in pairs], np.stack([undistorted_box(camera, box) for camera, box in pairs]))
    sides = [
        side
        for (camera, box), depth in zip(pairs, met.depths, strict=True)
        if depth > 0 and (side := _longer_side(camera, box, depth)) is not None
    ]
    return float(np.median(sides)) if sides and met.hits >= 2 else None


def subject_centre(capture: Capture, boxes: Mapping[str, MaskBox | None]) -> Float[np.ndarray, "3"] | None:
    """The point (m, world) that the rays through most boxes pass; None: fewer than two thirds of them do."""
    pairs = [(view.camera, box) for view in capture.views if (box := boxes.get(view.name)) is not None]
    if len(pairs) < 3:
        return None
    met = meeting([camera for camera, _ in pairs], np.stack([undistorted_box(camera, box) for camera, box in pairs]))
    return met.point if 3 * met.hits >= 2 * len(pairs) else None


def check_landmark_size(capture: Capture, scheme: str, points: Float[np.ndarray, "L 3"]) -> None:
    """Refuse triangulated landmarks (m, world; NaN: failed) whose extent is none of a head's. Raises InputError."""
    valid = points[np.isfinite(points).all(-1)]
    if len(valid) >= _MIN_LANDMARKS:
        extent = float(np.linalg.norm(np.percentile(valid, 90, axis=0) - np.percentile(valid, 10, axis=0)))
        check_extent(capture, f"landmarks of scheme {scheme}", extent, LANDMARKS_M, _FACE_M)


def check_extent(
    capture: Capture, what: str, extent_m: float, limits_m: tuple[float, float], typical_m: tuple[float, float]
) -> None:
    """Refuse an extent outside the limits, which is a sign of another unit. Raises InputError."""
    if limits_m[0] <= extent_m <= limits_m[1]:
        return
    raise wrong_unit(
        capture,
        "The world is not in metres",
        f"{what} of a head, {limits_m[0]:g} to {limits_m[1]:g} m large",
        f"{what} that are {extent_m:.3g} m large",
        extent=extent_m,
        limits_m=typical_m,
    )


@dataclass(frozen=True, kw_only=True)
class Meeting:
    """The point that most rays pass."""

    hits: int  # views in which it lies in front, in or near the mask's box
    miss: float  # mean distance from the boxes' centres in these views, in sides of the box
    depths: Float[np.ndarray, "N"]  # m
    behind: int  # views that have it behind them, if the rays are taken as lines
    point: Float[np.ndarray, "3"]  # m, world


def meeting(cameras: Sequence[Camera], ends: Float[np.ndarray, "N 2 2"]) -> Meeting:
    """Find it among the points nearest to pairs of lines, and to all."""
    centres = np.stack([camera.centre for camera in cameras])
    middle, half = ends.mean(1), (ends[:, 1] - ends[:, 0]) / 2 * (1 + 2 * _MARGIN)
    rays = np.stack(
        [
            camera.T_cam_world[:3, :3].T @ np.linalg.solve(camera.intrinsics, [*pixel, 1.0])
            for camera, pixel in zip(cameras, middle, strict=True)
        ]
    )
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    across = np.eye(3) - rays[:, :, None] * rays[:, None]
    origin = centres.mean(0)
    right = np.einsum("nij,nj->ni", across, centres - origin)
    pairs = np.array(list(combinations(range(len(cameras)), 2)))
    pairs = pairs[np.unique(np.linspace(0, len(pairs) - 1, _MAX_PAIRS).astype(int))]
    systems = np.concatenate([across[pairs].sum(1), across.sum(0)[None]])
    rights = np.concatenate([right[pairs].sum(1), right.sum(0)[None]])
    points = (np.linalg.pinv(systems, rcond=1e-9) @ rights[..., None])[..., 0] + origin
    pixels, depths = zip(*(camera.project(points) for camera in cameras), strict=True)
    depth = np.stack(depths)  # N P
    miss = np.abs(np.stack(pixels) - middle[:, None]) / half[:, None]
    hit = (miss.max(-1) <= 1) & (depth > 0)
    distance = np.where(hit, miss.max(-1), 0).sum(0) / np.maximum(hit.sum(0), 1)
    best = np.lexsort((distance, -hit.sum(0)))[0]
    return Meeting(
        hits=int(hit[:, best].sum()),
        miss=float(distance[best]),
        depths=depth[:, best],
        behind=int((depth[:, -1] < 0).sum()),
        point=points[best],
    )


def undistorted_box(camera: Camera, box: MaskBox) -> Float[np.ndarray, "2 2"]:
    """The box in the image without distortion: low and high corner."""
    corners = np.array([[x, y] for x in (box.low[0], box.high[0]) for y in (box.low[1], box.high[1])])
    if camera.distortion:
        K = camera.intrinsics
        corners = cv2.undistortPoints(corners[:, None], K, np.array(camera.distortion), P=K)[:, 0]
    return np.stack([corners.min(0), corners.max(0)])


def _longer_side(camera: Camera, box: MaskBox, depth_m: float) -> float | None:
    """The longer side (m) of what a mask shows; of the sides that the image does not cut off at both ends."""
    size = np.array([camera.width_px, camera.height_px])
    whole = (box.low > 1) | (box.high < size - 1)
    sides = (box.high - box.low) / np.diag(camera.intrinsics)[:2] * depth_m
    return float(sides[whole].max()) if whole.any() else None


def wrong_poses(capture: Capture, expected: str, got: str, misreading: Misreading | None) -> FindingError:
    """The refusal of cameras that do not look at one subject, with the convention in which they would."""
    far = ", with 17 digits in a world so far from its origin" if _distance(capture) > _FAR_M else ""
    conventions = "world to camera, x right, y down, z forward"
    fix = None
    if misreading is not None:
        fix = CameraFix(what=f"read the poses as {misreading.name}: {misreading.edit}", change=misreading.camera)
    return Finding(
        kind="poses" if misreading is None else misreading.kind,
        severity="error",
        where=str(capture.root / "sparse"),
        believed="The cameras do not look at one subject",
        expected=expected,
        evidence=got if misreading is None else f"{got}; all is well if the poses are {misreading.name}",
        mend=f"check the poses: COLMAP's are {conventions}, quaternions w x y z{far}"
        if misreading is None
        else f"{misreading.edit}; COLMAP's poses are {conventions}",
        fix=fix,
    ).error
