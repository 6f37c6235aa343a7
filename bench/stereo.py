"""Measure stereo against the scan of a capture: coverage, depths and normals after both passes.

    python -m bench.stereo CAPTURE... [--surface perturbed none REGISTRATION] [--views N]

The second pass searches around the scan itself, moved by a smooth random millimetre (`perturbed`), around the first
pass's own depths (`none`), or around a registration (its folder), such as one of the recipe `in_model`. Pixels are
those of skin, lips and ears by the capture's label maps, or, without these, where the scan is seen; depths and normals
are those of the scan at the pixels' centres. Seconds are of the processor, on one core, and of the clock.
"""

import argparse
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Bool, Float
from rich.console import Console
from rich.table import Table

from registration.capture.native import read_capture
from registration.capture.pixels import read_view
from registration.capture.scan import read_scan
from registration.fit.initialization import select_spread_views
from registration.geometry.surface_views import SurfaceViews
from registration.stereo.depth_map import DepthMap
from registration.stereo.first_pass import first_depths
from registration.stereo.head_position import around_face, find_head
from registration.stereo.of_capture import Surface, read_photographs
from registration.stereo.second_pass import refined_depths, sharpened_depths
from registration.storage.registration_folder import load_registration
from registration.types import Camera, Capture

_SKIN = ("skin", "upper_lip", "lower_lip", "ears")
_WAVES, _WAVE_M, _MOVED_M = 40, 0.06, 1e-3
_CONFIDENT = 0.3


@dataclass(frozen=True, kw_only=True)
class Measured:
    """Errors over the pixels of all views."""

    coverage: float
    depth_mm: Float[np.ndarray, "P"]
    angle_deg: Float[np.ndarray, "P"]


def perturbed(
    vertices: Float[np.ndarray, "V 3"], normals: Float[np.ndarray, "V 3"], seed: int = 0
) -> Float[np.ndarray, "V 3"]:
    """Move vertices along their normals by smooth random offsets of 1 mm (root mean square), waves of 3 to 9 cm."""
    random = np.random.default_rng(seed)
    direction = random.normal(size=(_WAVES, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    direction *= 2 * np.pi / (_WAVE_M * random.uniform(0.7, 2, (_WAVES, 1)))
    offset = np.cos((vertices - vertices.mean(0)) @ direction.T + random.uniform(0, 2 * np.pi, _WAVES)).sum(1)
    return vertices + normals * (_MOVED_M * offset / np.sqrt((offset**2).mean()))[:, None]


def measure(
    maps: Sequence[DepthMap | None],
    surface: SurfaceViews,
    skin: Sequence[tuple[Camera, Bool[np.ndarray, "H W"]] | None],
    least: float = 0.0,
) -> Measured:
    """Compare maps with a surface, at pixels whose confidence is above `least`."""
    shown, found, depths, angles = 0, 0, [np.zeros(0)], [np.zeros(0)]
    for one, where in zip(maps, skin, strict=True):
        if one is None:
            continue
        truth = surface.view(one.camera)
        counted = np.isfinite(truth.depth)
        if where is not None:
            counted &= _in_window(where[1], where[0], one.camera)
        known = counted & (one.depth > 0) & (one.confidence > least)
        shown, found = shown + int(counted.sum()), found + int(known.sum())
        depths.append(np.abs(one.depth - truth.depth)[known] * 1e3)
        cosine = (truth.normals @ one.camera.T_cam_world[:3, :3].T * one.normals).sum(-1)[known]
        angles.append(np.degrees(np.arccos(np.clip(cosine, -1, 1))))
    return Measured(coverage=found / max(shown, 1), depth_mm=np.concatenate(depths), angle_deg=np.concatenate(angles))


def _in_window(mask: Bool[np.ndarray, "H W"], camera: Camera, window: Camera) -> Bool[np.ndarray, "h w"]:
    y, x = np.mgrid[: window.height_px, : window.width_px] + 0.5
    plane = np.stack([x, y, np.ones_like(x)], -1) @ np.linalg.inv(window.intrinsics).T
    pixels = (plane @ camera.intrinsics.T)[..., :2].astype(np.float32) - np.float32(0.5)
    return cv2.remap(mask.astype(np.uint8), pixels[..., 0], pixels[..., 1], cv2.INTER_NEAREST) > 0


def skin_of(capture: Capture) -> list[tuple[Camera, Bool[np.ndarray, "H W"]] | None]:
    """The pixels of each view's skin, lips and ears; None without label maps."""
    result: list[tuple[Camera, Bool[np.ndarray, "H W"]] | None] = []
    for view in capture.views:
        pixels = read_view(view, capture)
        if pixels.label_coverage is None:
            result.append(None)
            continue
        classes = [k for k, name in enumerate(capture.classes) if name in _SKIN]
        result.append((pixels.camera, pixels.label_coverage[..., classes].sum(-1) > 0.99))
    return result


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("captures", nargs="+", type=Path, metavar="CAPTURE")
    parser.add_argument("--surface", nargs="+", default=["perturbed", "none"], metavar="perturbed|none|REGISTRATION")
    parser.add_argument("--views", type=int, metavar="N", help="only so many views, spread around the head")
    options = parser.parse_args()
    heads = (
        "capture",
        "pass",
        "coverage",
        "depth mm median",
        "mean",
        "< 1 mm",
        "normals deg median",
        "mean",
        "CPU s",
        "s",
    )
    table = Table(*heads, title=f"after the colon: pixels of a confidence above {_CONFIDENT}")
    for path in options.captures:
        capture = read_capture(path)
        if options.views is not None:
            kept = select_spread_views([view.camera for view in capture.views], options.views)
            capture = replace(capture, views=tuple(capture.views[k] for k in sorted(kept)))
        for row in rows(capture, options.surface):
            table.add_row("/".join(path.resolve().parts[-2:]), *row)
    Console(width=170).print(table)


def rows(capture: Capture, surfaces: Sequence[str]) -> list[tuple[str, ...]]:
    """Rows of the table for one capture, without its name."""
    if capture.scan is None:
        raise SystemExit(f"{capture.root} has no scan to compare with")
    scan = read_scan(capture.scan)
    truth = SurfaceViews(scan.vertices, scan.triangles, [view.camera for view in capture.views], smoothing_m=0)
    located = any(view.mask or view.landmarks for view in capture.views)
    head = find_head(capture) if located else around_face(scan.vertices, [view.camera for view in capture.views])
    views, skin = read_photographs(capture, head), skin_of(capture)
    result = []

    def timed(name: str, work) -> tuple[DepthMap | None, ...]:  # noqa: ANN001
        clock, cpu = time.perf_counter(), time.process_time()
        maps = work()
        cpu, clock = time.process_time() - cpu, time.perf_counter() - clock
        all_, sure = measure(maps, truth, skin), measure(maps, truth, skin, _CONFIDENT)
        result.append((name, *_cells(all_, sure), f"{cpu:.0f}", f"{clock:.0f}"))
        return maps

    first = timed("first", lambda: first_depths(views, head.centre, head.radius_m))
    for name in surfaces:
        if name == "none":
            timed("second, around the first", lambda: sharpened_depths(views, first, head.centre))
        else:
            mesh = _surface(name, scan.vertices, scan.triangles, truth)
            timed(f"second, around {Path(name).name}", lambda mesh=mesh: refined_depths(views, *mesh))
    return result


def _surface(name: str, vertices: np.ndarray, triangles: np.ndarray, truth: SurfaceViews) -> Surface:
    if name == "perturbed":
        return perturbed(vertices, truth.normals), triangles
    registered = load_registration(Path(name))
    return registered.vertices, registered.triangles


def _cells(all_: Measured, sure: Measured) -> tuple[str, ...]:
    def pair(value, form: str) -> str:  # noqa: ANN001
        return " : ".join(format(value(one), form) if len(one.depth_mm) else "-" for one in (all_, sure))

    return (
        pair(lambda m: m.coverage, ".2f"),
        pair(lambda m: float(np.median(m.depth_mm)), ".3f"),
        pair(lambda m: float(m.depth_mm.mean()), ".3f"),
        pair(lambda m: float((m.depth_mm < 1).mean()), ".3f"),
        pair(lambda m: float(np.median(m.angle_deg)), ".2f"),
        pair(lambda m: float(m.angle_deg.mean()), ".2f"),
    )


if __name__ == "__main__":
    main()
