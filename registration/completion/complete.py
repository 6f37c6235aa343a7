"""Complete a capture: detect landmarks, fit the model, make masks, labels, depths and normals, in the order of need.

Each step needs those before it: landmarks say where the head is; around it stereo finds depths, and with them the
subject is told from the background; the model is fitted to all of that; its own classes become labels, and stereo
searches again close to its surface.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from time import perf_counter
from typing import Any, TypeVar

import numpy as np
from jaxtyping import Float, UInt8

from registration.capture.class_names import NECK
from registration.capture.pixels import read_coverage, read_photograph, undistort_landmarks
from registration.completion.channels import (
    attach,
    uncertain,
    write_depths,
    write_labels,
    write_landmarks,
    write_masks,
)
from registration.completion.first_fit import FittedHead, HeadFitter
from registration.completion.plan import CompletionPlan, has_landmarks
from registration.detect.detection import detect_landmarks
from registration.detect.pictures import draw_detections
from registration.detect.provider import LandmarkProvider
from registration.errors import InputError
from registration.progress import Progress
from registration.segment import fitted
from registration.segment.labels import fitted_labels
from registration.segment.masks import first_masks
from registration.segment.views import SegmentView
from registration.stereo.depth_map import DepthMap
from registration.stereo.first_pass import first_depths
from registration.stereo.second_pass import refined_depths
from registration.stereo.views import StereoView
from registration.storage.cache import cache_folder, make_cache_folder
from registration.types import Camera, Capture, HeadPose


def refused_folder() -> Path:
    """Return the folder of pictures of captures whose landmarks were refused."""
    return cache_folder() / "refused"


T = TypeVar("T")
CODE = 2  # raised when the same inputs give other channels
_HEAD_PX = 700  # largest height of the head in the images that channels are made from


class Completer:
    """Makes the channels of a plan.

    Args:
        plan: what to make.
        fitter: of the head.
        provider: of landmarks.
        origin: of the fitter's world in the capture's, metres.
        progress: where to report to.
    """

    def __init__(
        self,
        plan: CompletionPlan,
        fitter: HeadFitter,
        provider: LandmarkProvider,
        origin: Float[np.ndarray, "3"],
        progress: Progress,
    ):
        self._plan, self._fitter, self._provider = plan, fitter, provider
        self._origin, self._progress = origin, progress
        self._root = Path()  # of the written channels
        self._seconds: dict[str, float] = {}
        self._figures: dict[str, Any] = {"channels": list(plan.channels)}
        self._notes: list[str] = []

    def complete(self, capture: Capture, root: Path) -> dict[str, Any]:
        """Write what the capture lacks into a folder.

        Args:
            capture: as it was given.
            root: the folder, laid out as a native capture.

        Returns:
            The record of it, as JSON values: `notes`, `figures`, `seconds` of each step, and `head_rows`, the height
            of the head in each view, px.

        Raises:
            InputError: nothing says where the head is.
        """
        self._root = root
        if self._plan.landmarks:
            self._timed("landmarks", lambda: self._detect(capture))
        rows = None
        if self._plan.masks or self._plan.labels or self._plan.normals:
            rows = self._make(capture)
        return {"notes": self._notes, "figures": self._figures, "seconds": self._seconds, "head_rows": rows}

    def _make(self, capture: Capture) -> dict[str, int]:
        """Masks, labels and depths."""
        made = self._attached(capture)
        head = self._timed("start", lambda: self._fitter.start(self._local(made), self._head_pose(capture)))
        photographs = self._timed("photographs", lambda: self._photographs(made, head))
        stereo_views = [StereoView(image=image, camera=camera) for image, camera in photographs]
        depths = self._timed("stereo, first pass", lambda: self._first_depths(stereo_views, head))
        views = self._segment_views(made, photographs)
        masks = self._timed("masks", lambda: self._masks(made, views, head, depths))
        write_masks(self._root, capture, masks)
        write_depths(self._root, capture, depths or [None] * len(views))
        head = self._timed("fit", lambda: self._fitter.fit(self._local(self._attached(capture)), head))
        if self._plan.labels:
            self._timed("labels", lambda: self._label(capture, views, masks, head, depths))
        if depths is not None:
            depths = self._timed("stereo, second pass", lambda: self._refined(stereo_views, head))
            write_depths(self._root, capture, depths)
            self._figures["coverage"] = round(_coverage(fitted.FittedHead(head.vertices, self._fitter.data), depths), 3)
        return self._fitter.head_rows(head, self._local(capture))

    def _attached(self, capture: Capture) -> Capture:
        return attach(capture, self._root, fitted.CLASSES)

    def _timed(self, step: str, work: Callable[[], T]) -> T:
        start = perf_counter()
        result = work()
        self._seconds[step] = perf_counter() - start
        return result

    def _local(self, capture: Capture) -> Capture:
        return capture.cameras_relative_to(self._origin)

    def _head_pose(self, capture: Capture) -> HeadPose | None:
        head = capture.head
        return None if head is None else replace(head, translation=head.translation - self._origin)

    def _detect(self, capture: Capture) -> None:
        detected = detect_landmarks(capture, self._provider, progress=self._progress)
        self._notes += [f"landmarks: {warning}" for warning in detected.warnings]
        self._figures["landmarks"] = {
            "outcome": detected.outcome,
            "reason": detected.reason,
            "views": {view.name: f"{view.state}: {view.note}" for view in detected.views},
            "expression": dict(detected.hints),
        }
        if detected.usable:
            write_landmarks(self._root, detected.into(capture), detected.scheme)
        if detected.outcome == "found":
            return
        masked = any(view.mask or view.segmentation for view in capture.views)
        if masked or capture.head is not None or has_landmarks(capture, self._fitter.schemes):
            self._notes.append(f"landmarks were not detected: {detected.reason}")
            return
        picture = refused_folder() / f"{capture.subject} {capture.expression}.png".replace("/", " ")
        make_cache_folder(picture.parent)
        draw_detections(capture, detected, picture)
        error = detected.error(capture)
        raise InputError(
            error.what,
            where=error.where,
            expected=error.expected,
            got=f"{error.got}; look at {picture}",
            fix=f"{error.fix}; or give masks, with which the head is located without landmarks",
        )

    def _photographs(self, capture: Capture, head: FittedHead) -> list[tuple[UInt8[np.ndarray, "H W 3"], Camera]]:
        """The images without distortion, reduced so that the head has at most `_HEAD_PX`."""
        photographs = []
        for done, view in enumerate(self._local(capture).views):
            self._progress.update(done, len(capture.views), "reading photographs")
            depth = view.camera.project(head.centre[None])[1][0]
            size = 2 * head.radius_m * view.camera.intrinsics[0, 0] / max(depth, head.radius_m)
            photographs.append(read_photograph(view, downsample=max(1, int(size / _HEAD_PX))))
        return photographs

    def _first_depths(self, views: Sequence[StereoView], head: FittedHead) -> tuple[DepthMap | None, ...] | None:
        if not self._plan.normals:
            return None
        report = self._percent("stereo, first pass")
        try:
            return first_depths(views, head.centre, head.radius_m, progress=report)
        except InputError as error:  # the rest of the capture is of use without depths
            self._notes.append(f"no depths and normals could be made: {error.what.lower()}: {error.got}")
            self._figures["coverage"] = 0.0
            return None

    def _refined(self, views: Sequence[StereoView], head: FittedHead) -> tuple[DepthMap | None, ...]:
        report = self._percent("stereo, second pass")
        return refined_depths(views, head.vertices, self._fitter.data.triangles, progress=report)

    def _percent(self, label: str) -> Callable[[float], None]:
        return lambda done: self._progress.update(round(100 * done), 100, label)

    def _segment_views(
        self, capture: Capture, photographs: Sequence[tuple[UInt8[np.ndarray, "H W 3"], Camera]]
    ) -> list[SegmentView]:
        scheme = self._provider.scheme
        views = []
        for view, (image, camera) in zip(capture.views, photographs, strict=True):
            landmarks = None
            if scheme in view.landmarks:
                landmarks = undistort_landmarks(view, scheme)
                landmarks[:, :2] *= camera.intrinsics[0, 0] / view.camera.intrinsics[0, 0]
            views.append(SegmentView(name=view.name, image=image, camera=camera, landmarks=landmarks))
        return views

    def _masks(
        self,
        capture: Capture,
        views: Sequence[SegmentView],
        head: FittedHead,
        depths: Sequence[DepthMap | None] | None,
    ) -> list[Float[np.ndarray, "H W"]]:
        """Coverage of the subject on the photographs' pixels: the capture's own, or made."""
        nothing = np.zeros(0)
        made: Sequence[Float[np.ndarray, "H W"]] = [nothing] * len(views)
        if not all(view.mask for view in capture.views):
            made = first_masks(views, head.centre, head.radius_m, depths)
        return [
            mask
            if view.mask is None
            else read_coverage(view, downsample=view.camera.width_px // photograph.camera.width_px)
            for view, photograph, mask in zip(capture.views, views, made, strict=True)
        ]

    def _label(
        self,
        capture: Capture,
        views: Sequence[SegmentView],
        masks: Sequence[Float[np.ndarray, "H W"]],
        head: FittedHead,
        depths: Sequence[DepthMap | None] | None,
    ) -> None:
        self._progress.message("labels")
        fitted_head = fitted.FittedHead(head.vertices, self._fitter.data)
        labelled = fitted_labels(views, masks, fitted_head, depths=depths)
        unknown = [uncertain(view.mask) for view in labelled]
        # What is unknown is excluded by its label: in the mask it may be the subject's.
        shown = [np.where(where, 1, view.mask) for view, where in zip(labelled, unknown, strict=True)]
        labels = [
            np.where(where, fitted.INDEX[fitted.UNLABELLED], view.labels).astype(np.uint8)
            for view, where in zip(labelled, unknown, strict=True)
        ]
        write_masks(self._root, capture, shown)
        write_labels(self._root, capture, labels)


def _coverage(head: fitted.FittedHead, depths: Sequence[DepthMap | None]) -> float:
    """The share of the fitted head's pixels, without neck, that have a depth; over all views that show it."""
    found = shown = 0
    for made in depths:
        if made is not None:
            seen = head.view(made.camera)
            on_head = seen.inside & (seen.labels != fitted.INDEX[NECK])
            found, shown = found + int((on_head & (made.depth > 0)).sum()), shown + int(on_head.sum())
    return found / max(shown, 1)
