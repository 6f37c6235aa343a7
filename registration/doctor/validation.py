"""Checks of a capture before anything is computed: cameras, image files, landmarks and units."""

from pathlib import Path

import numpy as np
from jaxtyping import Float

from registration.capture import headers, label_maps, triangulation
from registration.capture.class_names import BACKGROUND
from registration.capture.dense_maps import is_colmap_map, read_colmap_map, read_depth
from registration.capture.samples import ViewSample, sample_views
from registration.capture.scan import SCANS, Scan
from registration.doctor import (
    contradictions,
    exchanged,
    landmark_checks,
    leftovers,
    normal_axes,
    rig_checks,
)
from registration.doctor.ledger import Channel, Ledger, require_weight, take_stock
from registration.doctor.scan_checks import scan_warnings
from registration.doctor.scan_frame import require_frames
from registration.doctor.scan_normals import scan_normals
from registration.errors import InputError
from registration.types import Capture, View

EYE_DISTANCE_M = (0.05, 0.15)  # between the outer corners; adults have 0.08 to 0.1
OUTER_EYES = (36, 45)  # of the 68 scheme


def validate_capture(capture: Capture, *, use_scan: bool = True) -> Ledger:
    """Check a capture before it is registered: the headers of all views first, then contents.

    Masks and label maps are decoded whole. Images of more than `samples.MAX_DECODED_PIXELS` are only checked for
    truncation, and so are all but some normal maps of more; other damage is reported when the views are decoded for the
    fit.

    Args:
        capture: as read.
        use_scan: whether the scan's normals stand in for missing normal maps.

    Returns:
        What of the capture counts, and what may be wrong with it.

    Raises:
        InputError: fewer than two views, a singular or non-finite camera, a missing or damaged file, a size that is not
            the camera's, landmarks, a scan or true vertices that cannot be used or are in another unit or frame than
            the cameras, a world that is not in metres, or a kind of data of which nothing counts.
    """
    if len(capture.views) < 2:
        raise InputError(
            "There are too few views",
            where=capture.root,
            expected="at least 2 views",
            got=len(capture.views),
            fix="add calibrated images; in images.txt of COLMAP every image takes two lines, the second may be empty",
        )
    for view in capture.views:
        _check_camera(capture, view)
        _check_headers(capture, view)
    files = leftovers.match_files(capture)
    landmark_checks.check_values(capture)
    landmark_checks.check_coordinates(capture)
    points, agree, sized = _check_landmarks(capture)
    samples = sample_views(capture)
    boxes = {sample.name: _box(capture, sample) for sample in samples}
    rig_checks.check_mask_rays(capture, boxes, poses=not agree, size=not sized)
    scan = require_frames(capture)  # last: cameras that are wrong would blame them
    channels = take_stock(capture, samples, files)
    warnings = contradictions.check_views(capture, samples)
    cameras = [view.camera for view in capture.views]
    frame = capture.views[0].normals_frame
    warnings += normal_axes.check_normal_axes(capture.root / "normals", samples, cameras, frame)
    warnings += require_weight(capture, channels)
    warnings += exchanged.exchanged_views(capture, samples, points)
    warnings += landmark_checks.unnamed_schemes(capture)
    warnings += label_maps.renamed_classes(capture)
    rows = [_scan_channel(capture, scan)]
    if scan is not None:
        warnings += scan_warnings(capture, scan, points)
        if use_scan:
            row, found = scan_normals(capture, samples, scan)
            rows += [] if row is None else [row]
            warnings += found
    return Ledger(
        channels=(*channels, *rows),
        warnings=tuple(warnings),
        unread=tuple(leftovers.warnings(capture, files)),
        coverage={sample.name: sample.coverage for sample in samples},
        head_rows={sample.name: sample.head_rows for sample in samples},
    )


def _scan_channel(capture: Capture, scan: Scan | None) -> Channel:
    count, unused = (0, 0) if scan is None else (len(scan.vertices), scan.unused_vertices)
    return Channel(
        name=SCANS[0] if capture.scan is None else capture.scan.name,
        files=int(scan is not None),
        matched=int(scan is not None),
        unit="vertices",
        total=count + unused,
        counted=count,
        losses={"no face uses it": unused},
    )


def _check_camera(capture: Capture, view: View) -> None:
    camera = view.camera
    K, rotation = camera.intrinsics, camera.T_cam_world[:3, :3]
    if not (np.isfinite(K).all() and np.isfinite(camera.distortion).all() and K[0, 0] > 0 and K[1, 1] > 0):
        raise InputError(
            "The intrinsics are singular or not finite",
            where=f"{capture.root}: view {view.name}",
            expected="finite numbers, focal lengths > 0",
            got=np.array2string(K),
            fix="calibrate the camera again",
        )
    rigid = np.isfinite(camera.T_cam_world).all() and np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-4)
    if not (rigid and np.linalg.det(rotation) > 0):
        raise InputError(
            "The pose is singular or not finite",
            where=f"{capture.root}: view {view.name}",
            expected="a rotation and a finite translation",
            got=np.array2string(camera.T_cam_world),
            fix="calibrate the camera again, or remove its view",
        )


def _check_headers(capture: Capture, view: View) -> None:
    for path, role in _files(view):
        if is_colmap_map(path):
            read_colmap_map(path, role, view.camera, 3)
            continue
        header = headers.require_size(path, role, view.camera.width_px, view.camera.height_px)
        headers.require_complete(path, role)
        if role == "normal map" and header.png_bits != 16:
            raise InputError(
                "The normal map has too few bits",
                where=path,
                expected="16 bit RGB PNG, n = 2 v / 65535 - 1",
                got="no PNG" if header.png_bits is None else f"{header.png_bits} bits",
                fix="write it with 16 bits",
            )
    if view.depth is not None:
        read_depth(view)
    if view.segmentation is not None and not capture.classes:
        fits = label_maps.fitting_tables(capture.views)
        looks = f'the maps look like those of {" or ".join(fits)}: write table = "{fits[0]}"' if fits else ""
        raise InputError(
            "The label maps have no class names",
            where=capture.root / "capture.toml",
            expected='[segmentation] classes = ["background", ...], or table = "..."',
            got="nothing",
            fix=looks or "name every label index, or the table of the program that wrote the maps",
        )


def _files(view: View) -> list[tuple[Path, str]]:
    files = ((view.image, "image"), (view.mask, "mask"), (view.normals, "normal map"), (view.segmentation, "label map"))
    return [(path, role) for path, role in files if path is not None]


def _check_landmarks(capture: Capture) -> tuple[Float[np.ndarray, "L 3"], bool, bool]:
    """The triangulated points of scheme 68, whether landmarks confirm the poses, and whether they confirm the unit."""
    counts = {len(view.landmarks["68"]) for view in capture.views if "68" in view.landmarks}
    if counts - {68}:
        raise InputError(
            'The landmark scheme "68" has another length',
            where=capture.root / "landmarks",
            expected="68 points",
            got=", ".join(map(str, sorted(counts))),
            fix="give another scheme another name",
        )
    agree = rig_checks.check_landmark_rays(capture)
    points = triangulation.triangulate(capture, "68")[0]
    landmark_checks.check_chirality(capture, points)
    distance = eye_distance(points)
    if distance is not None and not EYE_DISTANCE_M[0] <= distance <= EYE_DISTANCE_M[1]:
        factor = 10.0 ** round(np.log10(0.09 / max(distance, 1e-12)))
        hint = f"scale the COLMAP model and the scan by about {factor:g}" if factor != 1 else "check the calibration"
        if contradict := exchanged.views_that_contradict(capture, points):
            raise InputError(
                "The landmarks of some views contradict the others",
                where=capture.root / "landmarks",
                expected="landmarks of one face in all views",
                got="; ".join(contradict),
                fix="mend these views, or remove their landmarks",
            )
        raise InputError(
            "The outer eye corners are too close or too far apart: check that the units are metres",
            where=capture.root / "sparse",
            expected=f"{EYE_DISTANCE_M[0]} to {EYE_DISTANCE_M[1]} m between the triangulated landmarks 36 and 45",
            got=f"{distance:.4g} m",
            fix=hint,
        )
    if distance is None:
        for name in {name for view in capture.views for name in view.landmarks}:
            rig_checks.check_landmark_size(capture, name, triangulation.triangulate(capture, name)[0])
    return points, agree, distance is not None


def eye_distance(points: Float[np.ndarray, "L 3"]) -> float | None:
    """Return the distance (m) between the outer eye corners; None for another scheme than 68 or a NaN corner."""
    if len(points) != 68:
        return None
    right, left = points[list(OUTER_EYES)]
    distance = float(np.linalg.norm(right - left))
    return distance if np.isfinite(distance) else None


def _box(capture: Capture, sample: ViewSample) -> rig_checks.MaskBox | None:
    """The box of a view's mask, or else of its labels, px of the stored image."""
    if sample.mask is None and (sample.labels is None or BACKGROUND not in capture.classes):
        return None
    box = rig_checks.mask_box(sample.subject)
    return box and rig_checks.MaskBox(low=box.low * sample.step, high=box.high * sample.step)
