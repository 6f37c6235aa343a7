"""Checks of a capture before any fitting, and the report behind `gnmreg capture check`."""

import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float
from rich.box import SIMPLE
from rich.console import Console
from rich.table import Table
from rich.text import Text
from scipy.spatial import cKDTree

from registration.capture import headers, native, pixels, triangulation
from registration.capture.contact_sheet import draw
from registration.capture.scan import Scan, read_scan, read_truth
from registration.errors import InputError
from registration.frames import MM_PER_M, opencv_intrinsics
from registration.geometry.meshlab import scan_topology
from registration.types import Camera, Capture, View

EYE_DISTANCE_M = (0.05, 0.15)  # between the outer corners; adults have 0.08 to 0.1
OUTER_EYES = (36, 45)  # of the 68 scheme
SMALL_PIXELS = 2**22  # images up to this size are decoded whole when a capture is validated
SCAN_NEAR_MM = 10.0  # median distance of the landmarks from the scan; landmarks lie on skin that it shows
NO_TOPOLOGY = "not checked, PyMeshLab is not installed or cannot start (make setup-mesh)"
_LENSES = {0: "pinhole", 4: "k1 k2 p1 p2", 5: "k1 k2 p1 p2 k3", 8: "k1 k2 p1 p2 k3..k6"}


def validate(capture: Capture) -> None:
    """Raise InputError for whatever would spoil a registration later. Headers of all views first, then contents.

    Masks and label maps are decoded whole. Large images and normal maps are only checked for being cut off: their
    pixels are read, and damage in their middle reported, when the views are decoded for the fit.
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
    _check_landmarks(capture)
    if capture.scan is not None:
        read_scan(capture.scan)
    if capture.ground_truth is not None:
        read_truth(capture.ground_truth)
    for view in capture.views:
        _check_pixels(capture, view)


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
    if view.segmentation is not None and not capture.classes:
        raise InputError(
            "The label maps have no class names",
            where=capture.root / "capture.toml",
            expected='[segmentation] classes = ["background", ...]',
            got="nothing",
            fix="name every label index",
        )


def _files(view: View) -> list[tuple[Path, str]]:
    files = ((view.image, "image"), (view.mask, "mask"), (view.normals, "normal map"), (view.segmentation, "label map"))
    return [(path, role) for path, role in files if path is not None]


def _check_landmarks(capture: Capture) -> None:
    counts = {len(view.landmarks["68"]) for view in capture.views if "68" in view.landmarks}
    if counts - {68}:
        raise InputError(
            'The landmark scheme "68" has another length',
            where=capture.root / "landmarks",
            expected="68 points",
            got=", ".join(map(str, sorted(counts))),
            fix="give another scheme another name",
        )
    points = triangulation.triangulate(capture, "68")[0]
    distance = eye_distance(points)
    if distance is not None and not EYE_DISTANCE_M[0] <= distance <= EYE_DISTANCE_M[1]:
        factor = 10.0 ** round(np.log10(0.09 / max(distance, 1e-12)))
        hint = f"scale the COLMAP model and the scan by about {factor:g}" if factor != 1 else "check the calibration"
        raise InputError(
            "The outer eye corners are too near or too far apart: are the units metres?",
            where=capture.root / "sparse",
            expected=f"{EYE_DISTANCE_M[0]} to {EYE_DISTANCE_M[1]} m between the triangulated landmarks 36 and 45",
            got=f"{distance:.4g} m",
            fix=hint,
        )


def eye_distance(points: Float[np.ndarray, "L 3"]) -> float | None:
    """Distance (m) of the outer eye corners of the 68 scheme, None where one of them is unknown."""
    if len(points) != 68:
        return None
    right, left = points[list(OUTER_EYES)]
    distance = float(np.linalg.norm(right - left))
    return distance if np.isfinite(distance) else None


def _check_pixels(capture: Capture, view: View) -> None:
    camera = view.camera
    if view.mask is not None:
        brightest = int(pixels.read_mask(view.mask, camera).max())
        if brightest < 128:
            raise InputError(
                "The mask is empty",
                where=view.mask,
                expected="255 where the subject is",
                got=f"no pixel above {brightest}",
                fix="write 255 for the subject" if brightest else "draw the mask, or remove this view or its mask",
            )
    if view.segmentation is not None:
        pixels.read_labels(view.segmentation, camera, capture.classes)
    if camera.width_px * camera.height_px <= SMALL_PIXELS:
        pixels.read_colour(view.image, camera)
        if view.normals is not None:
            pixels.read_normals(view.normals, camera)


@dataclass(frozen=True, kw_only=True)
class ViewReport:
    """What `check` found in one view."""

    name: str
    camera: Camera
    coverage: float | None  # share of the image that the mask covers
    normals: bool
    labels: bool
    landmarks: int  # with enough confidence to be used
    residual_px: float  # median distance of the landmarks from the triangulated ones; NaN if there are none
    outliers: tuple[int, ...]  # landmarks that the other views contradict

    @property
    def row(self) -> tuple[str, ...]:
        """The cells of the table."""
        return (
            self.name,
            f"{self.camera.width_px} x {self.camera.height_px}",
            _LENSES.get(len(self.camera.distortion), f"{len(self.camera.distortion)} coefficients"),
            "-" if self.coverage is None else f"{100 * self.coverage:.1f}",
            "yes" if self.normals else "-",
            "yes" if self.labels else "-",
            str(self.landmarks or "-"),
            "-" if np.isnan(self.residual_px) else f"{self.residual_px:.2f}",
            str(len(self.outliers) or "-"),
        )

    @property
    def caption(self) -> str:
        """One line for the contact sheet."""
        parts = [] if self.coverage is None else [f"mask {100 * self.coverage:.0f} %"]
        parts += [f"{self.landmarks} landmarks"] if self.landmarks else []
        parts += [] if np.isnan(self.residual_px) else [f"off by {self.residual_px:.2f} px"]
        parts += [f"{len(self.outliers)} wrong"] if self.outliers else []
        return ", ".join(parts)


@dataclass(frozen=True, kw_only=True)
class Report:
    """What `check` found; `str()` is the text that people read."""

    capture: Capture
    views: tuple[ViewReport, ...]
    schemes: Mapping[str, tuple[int, int]]  # landmark scheme -> points, of these triangulated
    eye_distance_mm: float | None
    scan: Scan | None
    warnings: tuple[str, ...]
    sheet: Path | None

    def __str__(self) -> str:
        heads = ("view", "size px", "lens", "mask %", "normals", "labels", "landmarks", "residual px", "outliers")
        table = Table(*heads, box=SIMPLE)
        for view in self.views:
            table.add_row(*map(Text, view.row))  # names may hold brackets, rich's markup
        text = io.StringIO()
        console = Console(file=text, width=200, color_system=None, legacy_windows=False)
        console.print(table)
        for line in [*self._facts(), *(f"warning: {warning}" for warning in self.warnings)]:
            console.print(line, soft_wrap=True, markup=False, highlight=False)
        return text.getvalue().rstrip()

    def _facts(self) -> list[str]:
        capture = self.capture
        facts = [f"{capture.root}: {capture.subject}, {capture.expression}; {len(self.views)} views, all checks passed"]
        facts += [f"{key}: {value}" for key, value in capture.tags.items()]
        if capture.classes:
            facts.append(f"classes: {', '.join(capture.classes)}")
        for scheme, (count, known) in self.schemes.items():
            facts.append(f"landmarks {scheme}: {known} of {count} triangulated")
        if self.eye_distance_mm is not None:
            facts.append(f"outer eye corners: {self.eye_distance_mm:.1f} mm apart")
        if self.scan is not None:
            extent = " x ".join(f"{MM_PER_M * side:.0f}" for side in np.ptp(self.scan.vertices, axis=0))
            facts.append(f"scan: {len(self.scan.vertices)} vertices, {len(self.scan.triangles)} faces, {extent} mm")
            if len(self.scan.triangles):
                topology = scan_topology(self.scan.vertices, self.scan.triangles)
                facts.append(f"scan's topology: {topology or NO_TOPOLOGY}")
        if capture.ground_truth is not None:
            facts.append(f"ground truth: {len(read_truth(capture.ground_truth))} vertices")
        if self.sheet is not None:
            facts.append(f"contact sheet: {self.sheet}")
        return facts


def check(path: Path, sheet: Path | None = None) -> Report:
    """Read and validate a native capture, look at everything it offers, and draw a contact sheet if asked to.

    Raises InputError as `native.read` and `validate` do; nothing is written then.
    """
    capture = native.read(path)
    validate(capture)
    scan = None if capture.scan is None else read_scan(capture.scan)
    names = sorted({name for view in capture.views for name in view.landmarks})
    solved = {name: triangulation.triangulate(capture, name)[0] for name in names}
    main = "68" if "68" in solved else next(iter(solved), None)
    points = solved[main] if main is not None else np.zeros((0, 3))
    views = tuple(_view_report(view, main, points) for view in capture.views)
    distance = eye_distance(solved.get("68", np.zeros((0, 3))))
    if sheet is not None:
        draw(capture, {view.name: view.caption for view in views}, main, points, scan, Path(sheet))
    return Report(
        capture=capture,
        views=views,
        schemes={name: (len(xyz), int(np.isfinite(xyz).all(-1).sum())) for name, xyz in solved.items()},
        eye_distance_mm=None if distance is None else MM_PER_M * distance,
        scan=scan,
        warnings=tuple(_warnings(capture, views, solved, scan)),
        sheet=sheet,
    )


def _view_report(view: View, scheme: str | None, points: Float[np.ndarray, "L 3"]) -> ViewReport:
    camera = view.camera
    errors, used = np.zeros(0), 0
    if scheme is not None and scheme in view.landmarks:
        errors = triangulation.residuals(view, scheme, points)
        used = int((view.landmarks[scheme][:, 2] > triangulation.MIN_CONFIDENCE).sum())
    known = errors[np.isfinite(errors)]
    return ViewReport(
        name=view.name,
        camera=camera,
        coverage=None if view.mask is None else float(pixels.read_mask(view.mask, camera).mean() / 255),
        normals=view.normals is not None,
        labels=view.segmentation is not None,
        landmarks=used,
        residual_px=float(np.median(known)) if len(known) else float("nan"),
        outliers=tuple(np.flatnonzero(errors > triangulation.inlier_limit_px(camera)).tolist()),
    )


def _warnings(
    capture: Capture, views: tuple[ViewReport, ...], solved: Mapping[str, Float[np.ndarray, "L 3"]], scan: Scan | None
) -> list[str]:
    warnings = []
    for part, missing in (
        ("a mask", [view.name for view in views if view.coverage is None]),
        ("normals", [view.name for view in views if not view.normals]),
        ("labels", [view.name for view in views if not view.labels]),
        ("landmarks", [view.name for view in views if not view.landmarks]),
    ):
        if missing:
            warnings.append(f"{len(missing)} of {len(views)} views without {part}: {_listed(missing)}")
    for view in views:
        if view.outliers:
            warnings.append(f"{view.name}: landmarks that other views contradict: {_listed(view.outliers)}")
        if _folds(view.camera):
            warnings.append(f"{view.name}: the distortion folds the image over itself; are its coefficients right?")
    for scheme, points in solved.items():
        if lost := np.flatnonzero(~np.isfinite(points).all(-1)).tolist():
            warnings.append(f"landmarks {scheme}: no two views agree on {_listed(lost)}")
    points = solved.get("68", np.zeros((0, 3)))
    if len(points) == 68 and (jaw := triangulation.jaw_disorder(points)):
        warnings.append(
            f"landmarks 68: {_listed(jaw)} go backwards; the jaw must run from the right ear over the chin to the left"
        )
    if scan is None:
        warnings.append("no scan: distances to it cannot be evaluated")
    elif np.isfinite(points).any():
        known = points[np.isfinite(points).all(-1)]
        distance = MM_PER_M * float(np.median(cKDTree(scan.vertices).query(known)[0]))
        if distance > SCAN_NEAR_MM:
            warnings.append(f"the scan is {distance:.0f} mm away from the landmarks: another frame or unit?")
    return warnings


def _listed(items: Sequence[object]) -> str:
    shown = ", ".join(map(str, items[:10]))
    return shown if len(items) <= 10 else f"{shown} and {len(items) - 10} more"


def _folds(camera: Camera) -> bool:
    """Whether undistortion would show some part of the image twice or mirrored."""
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
