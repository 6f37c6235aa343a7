"""The report of `gnmreg capture check`: what a capture offers, and what may be wrong with it."""

import io
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float
from rich.box import SIMPLE
from rich.console import Console
from rich.table import Table
from rich.text import Text

from registration.capture import triangulation
from registration.capture.file_colour import colour_name
from registration.capture.jaw_order import has_reversed_jaw
from registration.capture.scan import Scan, read_scan, read_truth
from registration.capture.text import listed
from registration.doctor.contact_sheet import draw_contact_sheet
from registration.doctor.diagnosis import Diagnosis, diagnose
from registration.doctor.ledger import Channel
from registration.doctor.scan_checks import scan_facts
from registration.doctor.size_checks import eye_distance
from registration.frames import MM_PER_M
from registration.geometry.meshlab import scan_topology
from registration.model.jaw_order import SCHEME
from registration.storage.files import check_output_file
from registration.types import Camera, Capture, View

NO_TOPOLOGY = "not checked, PyMeshLab is not installed or cannot start (make setup-optional)"
_LENSES = {0: "pinhole", 4: "k1 k2 p1 p2", 5: "k1 k2 p1 p2 k3", 8: "k1 k2 p1 p2 k3..k6"}


@dataclass(frozen=True, kw_only=True)
class ViewReport:
    """One view of a `CaptureReport`."""

    name: str
    camera: Camera
    coverage: float | None  # fraction of the image that the mask covers
    normals: bool
    labels: bool
    landmarks: int  # whose confidence suffices
    residual_px: float  # median distance of the landmarks from the triangulated ones; NaN if there are none
    outliers: tuple[int, ...]  # landmarks that the other views contradict

    @property
    def row(self) -> tuple[str, ...]:
        """Cells of the table."""
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
        """Line for the contact sheet."""
        parts = [] if self.coverage is None else [f"mask {100 * self.coverage:.0f} %"]
        parts += [f"{self.landmarks} landmarks"] if self.landmarks else []
        parts += [] if np.isnan(self.residual_px) else [f"off by {self.residual_px:.2f} px"]
        parts += [f"{len(self.outliers)} outliers"] if self.outliers else []
        return ", ".join(parts)


@dataclass(frozen=True, kw_only=True)
class CaptureReport:
    """Contents and warnings of a valid capture; `str()` is the text that the command prints."""

    capture: Capture
    views: tuple[ViewReport, ...]
    schemes: Mapping[str, tuple[int, int]]  # landmark scheme -> number of points, number of these triangulated
    eye_distance_mm: float | None
    scan: Scan | None
    channels: tuple[Channel, ...]
    warnings: tuple[str, ...]
    sheet: Path | None

    def __str__(self) -> str:
        heads = ("view", "size px", "lens", "mask %", "normals", "labels", "landmarks", "residual px", "outliers")
        views = Table(*heads, box=SIMPLE)
        for view in self.views:
            views.add_row(*map(Text, view.row))  # names may hold brackets, rich's markup
        ledger = Table("channel", "files", "of views", "counts", "lost to", box=SIMPLE)
        for channel in self.channels:
            ledger.add_row(*map(Text, channel.row))
        text = io.StringIO()
        console = Console(file=text, width=200, color_system=None, legacy_windows=False)
        console.print(views)
        console.print(ledger)
        for line in [*self._facts(), *(f"warning: {warning}" for warning in self.warnings)]:
            console.print(line, soft_wrap=True, markup=False, highlight=False)
        return text.getvalue().rstrip()

    def _facts(self) -> list[str]:
        capture = self.capture
        count = len(self.warnings)
        verdict = "all checks passed" if not count else f"usable, with {count} warning{'s' if count > 1 else ''}"
        facts = [f"{capture.root}: {capture.subject}, {capture.expression}; {len(self.views)} views, {verdict}"]
        facts += [f"{key}: {value}" for key, value in capture.tags.items()]
        if capture.classes:
            facts.append(f"classes: {', '.join(capture.classes)}")
        colours = Counter(map(colour_name, capture.views))
        if set(colours) != {"sRGB"}:
            facts.append(f"colours: {'; '.join(f'{name} ({views} views)' for name, views in colours.items())}")
        for scheme, (count, triangulated) in self.schemes.items():
            facts.append(f"landmarks {scheme}: {triangulated} of {count} triangulated")
            if scheme == SCHEME and has_reversed_jaw(capture):
                facts[-1] += "; points 2-6 of the right jaw are in reverse, and read in the scheme's order"
        if self.eye_distance_mm is not None:
            facts.append(f"outer eye corners: {self.eye_distance_mm:.1f} mm apart")
        if self.scan is not None:
            facts.append(f"scan: {scan_facts(self.scan)}")
            if len(self.scan.triangles):
                topology = scan_topology(self.scan.vertices, self.scan.triangles)
                facts.append(f"scan's topology: {topology or NO_TOPOLOGY}")
        if capture.ground_truth is not None:
            facts.append(f"ground truth: {len(read_truth(capture.ground_truth))} vertices")
        if self.sheet is not None:
            facts.append(f"contact sheet: {self.sheet}")
        return facts


def check_capture(path: Path, sheet: Path | None = None) -> CaptureReport:
    """Read and validate a native capture, and report what it offers.

    Args:
        path: the capture folder.
        sheet: PNG file for a contact sheet; None: none is drawn.

    Raises:
        InputError: the first error of `diagnose`; nothing is written then.
    """
    diagnosis = diagnose(path)
    if diagnosis.errors:
        raise diagnosis.errors[0].error
    return report_capture(diagnosis, sheet)


def report_capture(diagnosis: Diagnosis, sheet: Path | None = None) -> CaptureReport:
    """Report what a capture without errors offers.

    Args:
        diagnosis: of the capture.
        sheet: PNG file for a contact sheet; None: none is drawn.

    Raises:
        InputError: the sheet cannot be written.
    """
    if sheet is not None:
        check_output_file(Path(sheet))
    capture, ledger = diagnosis.capture, diagnosis.ledger
    assert capture is not None and ledger is not None
    scan = None if capture.scan is None else read_scan(capture.scan)
    names = sorted({name for view in capture.views for name in view.landmarks})
    triangulated = {name: triangulation.triangulate(capture, name)[0] for name in names}
    main = "68" if "68" in triangulated else next(iter(triangulated), None)
    points = triangulated[main] if main is not None else np.zeros((0, 3))
    views = tuple(_view_report(view, ledger.coverage.get(view.name), main, points) for view in capture.views)
    distance = eye_distance(triangulated.get("68", np.zeros((0, 3))))
    if sheet is not None:
        draw_contact_sheet(capture, {view.name: view.caption for view in views}, main, points, scan, Path(sheet))
    return CaptureReport(
        capture=capture,
        views=views,
        schemes={name: (len(xyz), int(np.isfinite(xyz).all(-1).sum())) for name, xyz in triangulated.items()},
        eye_distance_mm=None if distance is None else MM_PER_M * distance,
        scan=scan,
        channels=ledger.channels,
        warnings=(*_warnings(capture, views, triangulated, scan), *ledger.warnings, *ledger.unread),
        sheet=sheet,
    )


def _view_report(
    view: View, coverage: float | None, scheme: str | None, points: Float[np.ndarray, "L 3"]
) -> ViewReport:
    camera = view.camera
    errors, count = np.zeros(0), 0
    if scheme is not None and scheme in view.landmarks:
        errors = triangulation.residuals(view, scheme, points)
        count = int((view.landmarks[scheme][:, 2] > triangulation.MIN_CONFIDENCE).sum())
    valid = errors[np.isfinite(errors)]
    return ViewReport(
        name=view.name,
        camera=camera,
        coverage=coverage,
        normals=view.has_normals,
        labels=view.segmentation is not None,
        landmarks=count,
        residual_px=float(np.median(valid)) if len(valid) else float("nan"),
        outliers=tuple(np.flatnonzero(errors > triangulation.inlier_limit_px(camera)).tolist()),
    )


def _warnings(
    capture: Capture,
    views: tuple[ViewReport, ...],
    triangulated: Mapping[str, Float[np.ndarray, "L 3"]],
    scan: Scan | None,
) -> list[str]:
    warnings = []
    for part, missing in (
        ("a mask", [view.name for view in views if view.coverage is None]),
        ("normals", [view.name for view in views if not view.normals]),
        ("labels", [view.name for view in views if not view.labels]),
        ("landmarks", [view.name for view in views if not view.landmarks]),
    ):
        if missing:
            warnings.append(f"{len(missing)} of {len(views)} views without {part}: {listed(missing)}")
    for view in views:
        if view.outliers and not np.isnan(view.residual_px):
            warnings.append(f"{view.name}: landmarks that contradict the other views: {listed(view.outliers)}")
    for scheme, points in triangulated.items():
        lost = np.flatnonzero(~np.isfinite(points).all(-1))
        seen = _views_that_see(capture, scheme)
        if unseen := [int(i) for i in lost if seen[i] < 2]:
            hint = "the others say null or a low confidence"
            warnings.append(f"landmarks {scheme}: not triangulated, fewer than two views see {listed(unseen)}; {hint}")
        if disputed := [int(i) for i in lost if seen[i] > 1]:
            warnings.append(f"landmarks {scheme}: not triangulated, no two views agree: {listed(disputed)}")
    points = triangulated.get("68", np.zeros((0, 3)))
    if len(points) == 68 and (jaw := triangulation.reversed_jaw_points(points)):
        warnings.append(
            f"landmarks 68: {listed(jaw)} go backwards; the jaw must run from the right ear over the chin to the left"
        )
    if scan is None:
        warnings.append("no scan: distances to it cannot be evaluated")
    return warnings


def _views_that_see(capture: Capture, scheme: str) -> list[int]:
    """Number of views in which each landmark is used."""
    views = [view.landmarks[scheme][:, 2] for view in capture.views if scheme in view.landmarks]
    return [int(count) for count in (np.stack(views) > triangulation.MIN_CONFIDENCE).sum(0)]
