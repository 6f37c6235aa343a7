"""All checks of a capture, in the order in which one fault can be blamed for another."""

from collections.abc import Callable, Collection, Sequence
from dataclasses import replace
from typing import TypeVar

import numpy as np
from jaxtyping import Float

from registration.capture import label_maps, triangulation
from registration.capture.class_names import BACKGROUND
from registration.capture.samples import ViewSample, sample_views, with_grey
from registration.capture.scan import SCANS, Scan, read_scan
from registration.doctor import (
    contradictions,
    conventions,
    exchanged,
    file_checks,
    landmark_checks,
    leftovers,
    normal_axes,
    rig_checks,
    size_checks,
    view_checks,
)
from registration.doctor.findings import Finding, warnings
from registration.doctor.ledger import Channel, Ledger, require_weight, take_stock
from registration.doctor.scan_checks import scan_warnings
from registration.doctor.scan_frame import require_frames
from registration.doctor.scan_normals import scan_normals
from registration.doctor.silhouettes import Silhouettes
from registration.doctor.surface_agreement import BodyWitness, ScanWitness
from registration.errors import InputError
from registration.model.regions import CLASSES
from registration.types import Capture, View

Result = TypeVar("Result")
_MIN_POINTS = 6  # landmarks that locate the subject
_SCAN_POINTS = 5000  # on which the views are compared
# First word of a finding's kind -> field of a view.
_CHANNELS = {"mask": "mask", "labels": "segmentation", "normals": "normals", "landmarks": "landmarks"}


class Examination:
    """The checks of one capture.

    An error with one mend is mended in memory, so that the next checks say what else is wrong. A file with another
    error is left out of the next checks.
    """

    def __init__(self, capture: Capture, *, use_scan: bool = True):
        self.capture = capture  # as it would be with the mends
        self.findings: list[Finding] = []
        self.samples: list[ViewSample] = []
        self.points: Float[np.ndarray, "L 3"] = np.zeros((0, 3))  # of scheme 68, m, world
        self.ledger: Ledger | None = None  # None: the checks ended early
        self._left_out: set[str] = set()  # channels
        self._attempt("views", file_checks.check_count, capture)
        if not self.findings and self._check_files():
            self._check_landmarks()
            if self._sample():
                self._check_contents(use_scan)

    @property
    def errors(self) -> list[Finding]:
        """The findings for which a registration is refused."""
        return [finding for finding in self.findings if finding.severity == "error"]

    def _attempt(self, kind: str, check: Callable[..., Result], *arguments: object) -> Result | None:
        """The result of a check; None if it found an error, which becomes a finding and is mended, or left out."""
        try:
            return check(*arguments)
        except InputError as error:
            finding = Finding.of_error(error, kind)
        self.findings.append(finding)
        if (fix := finding.fix) is not None:
            self.capture = fix.on_capture(self.capture)
            pairs = zip(self.samples, self.capture.views, strict=bool(self.samples))
            self.samples = [fix.on_sample(sample, view.camera) for sample, view in pairs]
        else:
            self._leave_out(finding.kind.partition("-")[0])
        return None

    def _leave_out(self, part: str) -> None:
        """Ignore a part of the capture that cannot be used."""
        views = self.capture.views
        if part in _CHANNELS:
            self._left_out.add({"mask": "masks"}.get(_CHANNELS[part], _CHANNELS[part]))
            views = tuple(file_checks.without(view, _CHANNELS[part]) for view in views)
            self.samples = [_without(sample, part) for sample in self.samples]
        scan = None if part == "scan" else self.capture.scan
        truth = None if part == "ground" else self.capture.ground_truth
        self.capture = replace(self.capture, views=views, scan=scan, ground_truth=truth)

    def _check_files(self) -> bool:
        """Check cameras and headers; what is faulty is left out of the other checks. False: too little is left."""
        kept = []
        for view in self.capture.views:
            before = len(self.findings)
            self._attempt("camera", file_checks.check_camera, self.capture, view)
            if (
                len(self.findings) == before
                and (readable := self._readable(view, file_checks.check_headers)) is not None
            ):
                kept.append(readable)
        self.capture = replace(self.capture, views=tuple(view for view in kept if view is not None))
        return len(self.capture.views) > 1

    def _readable(self, view: View, check: Callable[[Capture, View], object]) -> View | None:
        """The view without the files that a check refuses; None if it is the image."""
        while True:
            try:
                check(self.capture, view)
                return view
            except InputError as error:
                self.findings.append(Finding.of_error(error, "file"))
                where = self.findings[-1].where
            field = next((f for f in file_checks.ROLES if str(getattr(view, f)) == where), None)
            if where.endswith("capture.toml"):
                field = "segmentation"
            if field is None or field == "image":
                return None
            view = file_checks.without(view, field)

    def _check_landmarks(self) -> None:
        self._attempt("landmarks", landmark_checks.check_values, self.capture)
        self._attempt("landmarks", size_checks.check_scheme_length, self.capture)
        if (witness := rig_checks.LandmarkWitness.of(self.capture)) is not None:
            self._attempt("intrinsics", conventions.check_intrinsics, self.capture, witness)
        self._attempt("landmarks", landmark_checks.check_coordinates, self.capture)

    def _sample(self) -> bool:
        """Decode the views; what cannot be decoded is left out. False: too little is left."""
        try:
            self.samples = sample_views(self.capture)
            return True
        except InputError:  # some file; find all of them
            kept = [self._readable(v, lambda c, v: sample_views(replace(c, views=(v,)))) for v in self.capture.views]
        self.capture = replace(self.capture, views=tuple(view for view in kept if view is not None))
        self.samples = sample_views(self.capture)
        return len(self.samples) > 1

    def _check_contents(self, use_scan: bool) -> None:
        files = leftovers.match_files(self.capture)
        self._attempt("files", leftovers.require_matches, self.capture, files)
        self._attempt("mask", contradictions.check_inverted, self.capture, self.samples)
        self._attempt("landmarks", contradictions.check_landmarks_inside, self.capture, self.samples)
        self._check_rig()
        scan = self._attempt("scan", require_frames, self.capture)  # last: cameras that are wrong would blame them
        cameras = [view.camera for view in self.capture.views]
        folder = self.capture.root / "normals"
        stated = self.capture.views[0].normals_frame
        lines = self._attempt("normals", normal_axes.check_normal_axes, folder, self.samples, cameras, stated)
        self._warn("normals-axes", lines)
        self._attempt("labels", contradictions.check_labels, self.capture, self.samples)
        self._attempt("face", view_checks.check_face, self.capture, self.samples)
        if self.findings and self.findings[-1].kind == "face-unseen":
            self._left_out.add("landmarks")  # none counts because of that
        self.findings += view_checks.lens_warnings(self.capture)
        self.findings += view_checks.exposure_warnings(self.capture, self.samples)
        unseen = view_checks.unseen_warnings(self.capture, self._centre())
        self.findings += unseen
        self.findings += contradictions.view_warnings(self.capture, self.samples)
        channels = take_stock(self.capture, self.samples, files)
        kept = [channel for channel in channels if channel.name not in self._left_out]
        self._warn("ledger", self._attempt("ledger", require_weight, self.capture, kept))
        lines = exchanged.exchanged_views(self.capture, self.samples, self.points)
        named = [line for line in lines if not any(line.partition(":")[0] in finding.line for finding in unseen)]
        self._warn("views-exchanged", named)
        self._warn("landmarks-scheme", landmark_checks.unnamed_schemes(self.capture))
        self._warn("labels-vocabulary", label_maps.renamed_classes(self.capture))
        rows = [_scan_channel(self.capture, scan)]
        if scan is not None:
            self.findings += scan_warnings(self.capture, scan, self.points)
            if use_scan:
                row, found = scan_normals(self.capture, self.samples, scan)
                rows += [] if row is None else [row]
                self._warn("scan-normals", found)
        warned = tuple(finding.line for finding in self.findings if finding.severity == "warning")
        unread = leftovers.unread(self.capture, files)
        self.findings += unread
        self.ledger = Ledger(
            channels=(*channels, *rows),
            warnings=warned,
            unread=tuple(finding.line for finding in unread),
            coverage={sample.name: sample.coverage for sample in self.samples},
            head_rows={sample.name: sample.head_rows for sample in self.samples},
        )

    def _warn(self, kind: str, lines: Sequence[str] | None) -> None:
        self.findings += warnings(kind, lines or ())

    def _check_rig(self) -> None:
        """Check K, poses and unit, by landmarks or else by masks and images."""
        before = len(self.findings)
        agree = self._attempt("poses", rig_checks.check_landmark_rays, self.capture)
        agree = bool(agree) or (len(self.findings) > before and self.findings[-1].fix is not None)
        self._triangulate()
        self._attempt("landmarks", landmark_checks.check_chirality, self.capture, self.points)
        self._triangulate()
        before = len(self.findings)
        sized = self._attempt("unit", size_checks.check_size, self.capture, self.points)
        sized = bool(sized) or len(self.findings) > before
        self._triangulate()
        boxes = {sample.name: _box(self.capture, sample) for sample in self.samples}
        if not agree and (witness := self._body(boxes)) is not None:
            self._attempt("intrinsics", conventions.check_intrinsics, self.capture, witness)
            before = len(self.findings)
            self._attempt("poses", rig_checks.check_poses, self.capture, witness)
            agree = len(self.findings) > before
        before = len(self.findings)
        self._attempt("poses", lambda: rig_checks.check_mask_rays(self.capture, boxes, poses=not agree, size=not sized))
        if not sized and len(self.findings) == before:
            heads = {sample.name: _head_box(self.capture, sample) for sample in self.samples}
            if any(heads.values()):
                self._attempt("unit", size_checks.check_head_size, self.capture, heads)
            else:
                self.findings += size_checks.large_subject(self.capture, boxes)

    def _centre(self) -> Float[np.ndarray, "3"] | None:
        """The centre of the subject, by landmarks or else by masks; None: nothing tells."""
        if np.isfinite(self.points).all(-1).sum() >= _MIN_POINTS:
            return np.nanmedian(self.points, axis=0)
        boxes = {sample.name: _box(self.capture, sample) for sample in self.samples if sample.coverage is not None}
        return rig_checks.subject_centre(self.capture, boxes)

    def _triangulate(self) -> None:
        self.points = triangulation.triangulate(self.capture, "68")[0]

    def _body(self, boxes: dict[str, rig_checks.MaskBox | None]) -> BodyWitness | ScanWitness | None:
        """What the views should agree on without landmarks: the hull of the masks, else the scan."""
        if (silhouettes := Silhouettes.of(self.capture, self.samples, boxes)) is not None:
            return BodyWitness(silhouettes=silhouettes, samples=self._with_grey(silhouettes.numbers))
        try:
            vertices = np.zeros((0, 3)) if self.capture.scan is None else read_scan(self.capture.scan).vertices
        except InputError:  # it is refused later
            return None
        some = vertices[:: max(1, len(vertices) // _SCAN_POINTS)]
        return ScanWitness(points=some, samples=self._with_grey(range(len(self.samples)))) if len(some) else None

    def _with_grey(self, numbers: Collection[int]) -> list[ViewSample]:
        """The samples, some of them with the grey values of large images; those that cannot be decoded as they are."""
        try:
            return [
                with_grey(sample, view) if number in numbers else sample
                for number, (sample, view) in enumerate(zip(self.samples, self.capture.views, strict=True))
            ]
        except InputError:  # it is refused when the fit decodes it
            return self.samples


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


def _box(capture: Capture, sample: ViewSample) -> rig_checks.MaskBox | None:
    """The box of a view's mask, or else of its labels, px of the stored image."""
    if sample.mask is None and (sample.labels is None or BACKGROUND not in capture.classes):
        return None
    box = rig_checks.mask_box(sample.subject)
    return box and rig_checks.MaskBox(low=box.low * sample.step, high=box.high * sample.step)


def _head_box(capture: Capture, sample: ViewSample) -> rig_checks.MaskBox | None:
    """The box of the labels of a head without its neck, px of the stored image; None without such labels."""
    if sample.labels is None or BACKGROUND not in capture.classes or "skin" not in capture.classes:
        return None
    other = [index for index, name in enumerate(capture.classes) if name not in CLASSES]
    box = rig_checks.mask_box(~np.isin(sample.labels, other) & (sample.labels < len(capture.classes)))
    return box and rig_checks.MaskBox(low=box.low * sample.step, high=box.high * sample.step)


def _without(sample: ViewSample, part: str) -> ViewSample:
    """A sample without what cannot be used."""
    if part == "mask":
        return replace(sample, mask=None, coverage=None, subject=np.ones_like(sample.subject))
    if part == "labels":
        return replace(sample, labels=None)
    return replace(sample, normals=None) if part == "normals" else sample
