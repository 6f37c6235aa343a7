"""Stereo of a whole capture: photographs read, both passes, maps and a cloud written as files of a capture."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from registration.capture.native_writer import write_channels
from registration.capture.pixels import read_view
from registration.errors import InputError
from registration.frames import linear_to_srgb
from registration.stereo.backends import load_backend
from registration.stereo.depth_map import DepthMap
from registration.stereo.fuse import Cloud, fuse
from registration.stereo.head_position import HeadPosition
from registration.stereo.pictures import draw_sheet
from registration.stereo.second_pass import refined_depths, sharpened_depths
from registration.stereo.stored import stored_maps
from registration.stereo.views import MOST_PX, StereoView
from registration.storage.files import atomic_directory
from registration.storage.mesh import write_ply
from registration.types import Capture, View

_LOW_COVERAGE = 0.2  # of the pixels of the head's disc with a depth, median over views
_LOW_CONFIDENCE = 0.25  # median of the pixels with a depth
_DISC = 0.7  # of the sphere's radius, in which a head fills the picture
_LEAST_CONFIDENCE = 0.02  # of a depth that is written

Surface = tuple[Float[np.ndarray, "V 3"], Int[np.ndarray, "F 3"]]  # vertices (world, metres) and triangles


@dataclass(frozen=True, kw_only=True, eq=False)
class CaptureDepths:
    """What stereo found in a capture."""

    maps: tuple[DepthMap | None, ...]  # of the capture's views
    cloud: Cloud
    coverage: float  # of the middle of the head by depths, median over views
    confidence: float  # median over the pixels with a depth
    warnings: tuple[str, ...] = field(default=())


def read_photographs(capture: Capture, head: HeadPosition, most_px: int = MOST_PX) -> tuple[StereoView, ...]:
    """Read a capture's photographs without distortion, reduced so that the head has about `most_px` or more.

    Raises:
        InputError: an image or a mask cannot be read.
    """
    return tuple(_read(view, capture, head, most_px) for view in capture.views)


def capture_depths(
    capture: Capture,
    views: Sequence[StereoView],
    head: HeadPosition,
    surface: Surface | None = None,
    backend: str = "sgbm",
    progress: Callable[[float], None] | None = None,
) -> CaptureDepths:
    """Estimate depths of a capture, in two passes.

    Args:
        capture: names the views.
        views: its photographs.
        head: where the head is.
        surface: a mesh within about 4 mm of the head, such as a fitted model, around which the second pass searches.
            None: it searches around the first pass's own depths.
        backend: of the first pass; one that is not ours has no second pass, unless there is a surface.
        progress: called with the fraction done.

    Raises:
        InputError: fewer than two views show the head, none overlap, or the backend cannot be used.
    """
    report = progress or (lambda done: None)
    chosen = load_backend(backend)
    if surface is not None:
        maps = refined_depths(views, *surface, progress=report)
    else:
        first = chosen.depths(views, head.centre, head.radius_m, lambda done: report(done / 2))
        own = backend == "sgbm"
        maps = sharpened_depths(views, first, head.centre, progress=lambda d: report(0.5 + d / 2)) if own else first
    maps = tuple(one if one is None else _trusted(one) for one in maps)
    shares = [_coverage(one, head) for one in maps if one is not None]
    coverage = float(np.median(shares)) if shares else 0.0
    values = np.concatenate([np.zeros(0), *(one.confidence[one.depth > 0] for one in maps if one is not None)])
    confidence = float(np.median(values)) if len(values) else 0.0
    return CaptureDepths(
        maps=maps,
        cloud=fuse(maps),
        coverage=coverage,
        confidence=confidence,
        warnings=tuple(_warnings(capture, maps, head, coverage, confidence)),
    )


def write_depths(found: CaptureDepths, capture: Capture, views: Sequence[StereoView], out: Path) -> None:
    """Write `normals/`, `depth/`, `confidence/`, `scan.ply` and `stereo.png` into a new folder.

    Args:
        found: the depths.
        capture: names the views and has the stored photographs' cameras.
        views: its photographs.
        out: the folder, which appears in one rename; it must not exist.

    Raises:
        InputError: `out` exists.
    """
    check_out(out)
    with atomic_directory(out) as temporary:
        for view, one in zip(capture.views, found.maps, strict=True):
            if one is not None:
                write_channels(temporary, stored_maps(view.name, view.camera, one))
        if len(found.cloud.points) >= 3:
            faces = np.zeros((0, 3), np.int64)
            write_ply(temporary / "scan.ply", found.cloud.points, faces, found.cloud.normals)
        draw_sheet([view.name for view in capture.views], views, found.maps, temporary / "stereo.png")


def check_out(out: Path) -> None:
    """Refuse an output folder that exists, before anything is computed. Raises InputError."""
    if out.exists():
        raise InputError.output_folder(out, expected="a path that does not exist", got="a file or folder")


def _read(view: View, capture: Capture, head: HeadPosition, most_px: int) -> StereoView:
    camera = view.camera
    depth = float(camera.T_cam_world[2, :3] @ head.centre + camera.T_cam_world[2, 3])
    size = 2 * head.radius_m * camera.intrinsics[0, 0] / max(depth, head.radius_m)
    photograph = replace(view, normals=None, depth=None, confidence=None, segmentation=None)
    pixels = read_view(photograph, capture, downsample=max(1, int(size / most_px)))
    rgb = linear_to_srgb(np.clip(pixels.rgb, 0, 1)).astype(np.float32)
    return StereoView(image=rgb, camera=pixels.camera, mask=pixels.mask)


def _trusted(one: DepthMap) -> DepthMap:
    kept = one.confidence > _LEAST_CONFIDENCE
    return replace(
        one,
        depth=np.where(kept, one.depth, 0).astype(np.float32),
        normals=np.where(kept[..., None], one.normals, 0).astype(np.float32),
        confidence=np.where(kept, one.confidence, 0).astype(np.float32),
    )


def _coverage(one: DepthMap, head: HeadPosition) -> float:
    """Share of a disc in the middle of the head that has a depth."""
    (xy,), (depth,) = one.camera.project(head.centre[None])
    radius = _DISC * head.radius_m * one.camera.intrinsics[0, 0] / depth
    y, x = np.mgrid[: one.camera.height_px, : one.camera.width_px] + 0.5
    disc = (x - xy[0]) ** 2 + (y - xy[1]) ** 2 < radius**2
    return float((one.depth[disc] > 0).mean()) if disc.any() else 0.0


def _warnings(
    capture: Capture,
    maps: Sequence[DepthMap | None],
    head: HeadPosition,
    coverage: float,
    confidence: float,
) -> list[str]:
    beside = [view.name for view, one in zip(capture.views, maps, strict=True) if one is None]
    warnings = [f"the head is not in the photographs of {', '.join(beside)}"] if beside else []
    if coverage < _LOW_COVERAGE:
        warnings.append(
            f"depths cover {coverage:.0%} of the head, in the median over the views: blurred photographs, skin without "
            "texture, views that are far apart, or of different moments"
        )
    elif confidence < _LOW_CONFIDENCE:
        warnings.append(
            f"views agree little on depths (median confidence {confidence:.2f}): photographs of different moments, or "
            "cameras that are not exact"
        )
    return warnings
