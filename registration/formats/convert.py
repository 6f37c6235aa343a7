"""Write a capture that a reader of this room returned as a native capture folder (docs/formats.md)."""

import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from registration.capture import pixels
from registration.capture.colmap import write_model
from registration.capture.landmark_files import moved_spread, write_landmarks
from registration.capture.native import read_capture
from registration.capture.native_writer import CaptureDescription, check_new, write_settings
from registration.capture.scan import SCAN, SCANS, read_scan
from registration.errors import InputError
from registration.formats.geometry_channels import kept_normals, write_depth, written_normals
from registration.formats.plan import ViewPlan, plan_views
from registration.formats.source import SourceCapture, SourceView, VideoFrame
from registration.formats.undistort import scaled_world, turned
from registration.formats.units import world_unit
from registration.progress import NullProgress, Progress
from registration.storage.files import atomic_directory, write_json
from registration.storage.hashing import versions
from registration.storage.mesh import write_ply
from registration.storage.reading import open_file
from registration.types import Camera, Colour

RECORD = "import.json"
_KIND = "gnm-import"
_MASK_SUFFIXES = (".png", ".jpg", ".jpeg", ".tif", ".tiff")


@dataclass(frozen=True, kw_only=True)
class Imported:
    """What an import wrote.

    Attributes:
        root: the native capture folder.
        format: name of the source's format.
        views: their number.
        unit_m: metres per unit of the source's world.
        notes: what was decided or left out.
    """

    root: Path
    format: str
    views: int
    unit_m: float
    notes: tuple[str, ...]


def import_capture(
    source: SourceCapture, target: Path, *, unit_m: float | None = None, progress: Progress | None = None
) -> Imported:
    """Write a native capture folder, which appears in one rename. One image is in memory at a time.

    Image files whose lens a native camera holds are copied byte for byte, and so are their masks, normals and labels;
    other views are undistorted (`registration.formats.undistort`).

    Args:
        source: the capture.
        target: the folder to write; it must not exist.
        unit_m: metres per unit of the source's world; None: as its format says, or else estimated.
        progress: receives one step a view.

    Raises:
        InputError: `target` exists, a file or camera cannot be used, or the unit is not known. Nothing is written then.
    """
    target = Path(target)
    check_new(target)
    plans, notes = plan_views(source)
    unit_m, note = world_unit(source, plans, unit_m)
    notes = [*source.notes, *notes, *([note] if note else [])]
    progress = progress or NullProgress()
    cameras: dict[str, Camera] = {}
    with atomic_directory(target) as temporary:
        for number, plan in enumerate(plans):
            progress.update(number, len(plans), "views imported")
            cameras[_write_view(temporary, plan, source, unit_m)] = scaled_world(plan.camera, unit_m)
        progress.update(len(plans), len(plans), "views imported")
        write_model(temporary / "sparse", cameras, np.zeros((0, 3)))
        description = CaptureDescription(
            subject=source.subject,
            expression=source.expression,
            classes=source.classes,
            tags=source.tags,
            colours={plan.view.name: plan.view.colour for plan in plans if not _is_decoded(plan)},
        )
        write_settings(temporary / "capture.toml", description)
        notes += _write_scan(temporary, source.scan, unit_m)
        notes += _colour_notes(plans)
        write_json(temporary / RECORD, _record(source, plans, unit_m, notes))
        read_capture(temporary)
    return Imported(root=target, format=source.format, views=len(plans), unit_m=unit_m, notes=tuple(notes))


def _write_view(root: Path, plan: ViewPlan, source: SourceCapture, unit_m: float) -> str:
    """Write the files of a view. Returns its image's name."""
    view = plan.view
    suffix = view.image.suffix if plan.as_it_is and isinstance(view.image, Path) else ".png"
    image = _target(root / "images", view, suffix)
    if plan.as_it_is and isinstance(view.image, Path):
        _copy(view.image, image)
    else:
        _write_png(image, _through(plan, _decoded(plan)))
    camera = _source_camera(view)
    if view.mask is not None:
        if plan.lens is None and view.mask.suffix.lower() in _MASK_SUFFIXES:
            _copy(view.mask, _target(root / "masks", view, view.mask.suffix.lower()))
        else:
            mask = pixels.read_mask(view.mask, camera)
            _write_png(_target(root / "masks", view), mask if plan.lens is None else plan.lens.image(mask))
    if view.normals is not None:
        suffix_of_normals = kept_normals(plan)
        if suffix_of_normals is not None:
            _copy(view.normals, _target(root / "normals", view, suffix_of_normals))
        else:
            _write_png(_target(root / "normals", view), written_normals(plan))
    if view.depth is not None:
        write_depth(_target(root / "depth", view, ".npy"), plan, unit_m)
    if view.confidence is not None:
        if plan.lens is None:
            _copy(view.confidence, _target(root / "confidence", view))
        else:
            confidence = plan.lens.image(pixels.read_confidence(view.confidence, camera))
            _write_png(_target(root / "confidence", view), confidence)
    if view.segmentation is not None:
        labels = _target(root / "segmentation", view)
        if plan.lens is None and not (source.labels.indices or source.labels.colours):
            _copy(view.segmentation, labels)
        else:
            stored = pixels.read_labels(view.segmentation, camera, source.classes, source.labels)
            _write_png(labels, stored if plan.lens is None else plan.lens.labels(stored))
    if view.landmarks:
        move = partial(_landmarks, plan)
        moved = {name: move(rows) for name, rows in view.landmarks.items()}
        spreads = {
            name: spread_px if plan.lens is None else moved_spread(move, view.landmarks[name], spread_px)
            for name, spread_px in view.landmark_spread_px.items()
        }
        write_landmarks(_target(root / "landmarks", view, ".json"), moved, spreads)
    return f"{view.name}{suffix}"


def _landmarks(plan: ViewPlan, points: np.ndarray) -> np.ndarray:
    return points if plan.lens is None else plan.lens.landmarks(points)


def _through(plan: ViewPlan, image: np.ndarray) -> np.ndarray:
    return image if plan.lens is None else plan.lens.image(image)


def _decoded(plan: ViewPlan) -> np.ndarray:
    """The pixels of a view's image at its camera's size, before undistortion."""
    view = plan.view
    if isinstance(view.image, VideoFrame):
        return _video_frame(view, view.image)
    stored = Camera(
        width_px=plan.stored_px[0],
        height_px=plan.stored_px[1],
        intrinsics=view.intrinsics,
        T_cam_world=view.T_cam_world,
    )
    return turned(pixels.read_image(view.image, stored, view.colour), plan.orientation)


def _video_frame(view: SourceView, frame: VideoFrame) -> np.ndarray:
    """Decode one frame as (H, W, 3) RGB. All frames before it are passed: seeking is inexact in many files."""

    def refuse(expected: object, got: object) -> InputError:
        fix = "convert the video to images, or choose another frame with --frame"
        return InputError("The video frame cannot be read", where=frame.file, expected=expected, got=got, fix=fix)

    open_file(frame.file, refuse).close()
    video = cv2.VideoCapture(str(frame.file))
    try:
        passed = 0
        while passed < frame.index and video.grab():
            passed += 1
        whole, image = video.read() if passed == frame.index else (False, None)
    finally:
        video.release()
    if not whole or image is None:
        raise refuse(f"frame {frame.index}, counted from 0", f"a video of {passed} frames")
    if image.shape[:2] != (view.height_px, view.width_px):
        raise refuse(f"{view.width_px} x {view.height_px} px", f"{image.shape[1]} x {image.shape[0]} px")
    return np.ascontiguousarray(image[..., ::-1])


def _source_camera(view: SourceView) -> Camera:
    return Camera(
        width_px=view.width_px, height_px=view.height_px, intrinsics=view.intrinsics, T_cam_world=view.T_cam_world
    )


def _write_scan(root: Path, scan: Path | None, unit_m: float) -> list[str]:
    """Copy or scale the scan. Returns notes."""
    if scan is None:
        return []
    name = f"scan{scan.suffix.lower()}"
    if name not in SCANS:
        return [f"the scan {scan.name} was left out: convert it to {SCAN}"]
    if unit_m == 1:
        _copy(scan, root / name)
        return []
    mesh = read_scan(scan)
    write_ply(root / SCANS[0], mesh.vertices * unit_m, mesh.triangles)
    return ["the scan was scaled to metres: its vertices and triangles were written, without colours"]


def _is_decoded(plan: ViewPlan) -> bool:
    """Whether the written image is sRGB: decoded with the colour of its view."""
    return not plan.as_it_is and isinstance(plan.view.image, Path)


def _colour_notes(plans: Sequence[ViewPlan]) -> list[str]:
    coloured = [plan for plan in plans if plan.view.colour != Colour()]
    applied = sum(map(_is_decoded, coloured))
    stated = len(coloured) - applied
    return [f"colour corrections of {applied} views were applied to the written images"] * (applied > 0) + [
        f"colour corrections of {stated} views are in [colour] of capture.toml"
    ] * (stated > 0)


def _record(source: SourceCapture, plans: Sequence[ViewPlan], unit_m: float, notes: Sequence[str]) -> dict[str, Any]:
    return {
        "kind": _KIND,
        "schema": 1,
        "format": source.format,
        "source": str(source.root),
        "unit_m": unit_m,
        "notes": list(notes),
        "versions": versions(),
        "views": {plan.view.name: _view_record(source, plan) for plan in plans},
    }


def _view_record(source: SourceCapture, plan: ViewPlan) -> dict[str, Any]:
    view = plan.view
    video = view.image if isinstance(view.image, VideoFrame) else None
    image = view.image.file if isinstance(view.image, VideoFrame) else view.image
    files = {part: getattr(view, part) for part in ("mask", "normals", "depth", "confidence", "segmentation")}
    named = {part: _name(source, file) for part, file in files.items() if file is not None}
    record: dict[str, Any] = {"image": _name(source, image), **named}
    if video is not None:
        record["frame"] = video.index
    if plan.orientation != 1:
        record["turned_by_orientation"] = plan.orientation
    if plan.lens is not None:
        record["undistorted"] = {"model": view.distortion.model, "coefficients": list(view.distortion.coefficients)}
        record["intrinsics"] = view.intrinsics.tolist()
    if view.colour != Colour():
        record["colour"] = {name: getattr(view.colour, name) for name in ("encoding", "matrix", "matrix_space", "gain")}
    return record


def _name(source: SourceCapture, file: Path) -> str:
    """The path below the source's folder, or else the whole one."""
    absolute = file.absolute()
    root = source.root.absolute()
    return absolute.relative_to(root).as_posix() if absolute.is_relative_to(root) else str(file)


def _target(folder: Path, view: SourceView, suffix: str = ".png") -> Path:
    path = folder / f"{view.name}{suffix}"
    path.parent.mkdir(parents=True, exist_ok=True)
    return path


def _copy(file: Path, target: Path) -> None:
    refuse = partial(InputError, "A file of the capture cannot be read", where=file, fix="check it, and import again")
    with open_file(file, refuse) as stream, target.open("wb") as written:
        shutil.copyfileobj(stream, written, 2**20)


def _write_png(path: Path, content: np.ndarray) -> None:
    if not cv2.imwrite(str(path), content[..., ::-1] if content.ndim == 3 else content):
        raise OSError(f"{path} cannot be written")
