"""Calibrate the photographs of captures without their cameras, and measure the result against these.

    python -m bench.calibrate --model gnm_head.npz CAPTURE ... [--views 22] [--focal-px 6375] [--distance-of-cameras]

Printed per capture: views with a camera, the reprojection error of the scan's points by the estimated cameras against
the true ones after the best similarity transform (rms, and of the worst view), that transform's scale (1 if the metric
scale is right) beside its stated standard deviation, the focal length against the mean of the true ones, and seconds.
"""

import argparse
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from registration.calibrate.calibration import calibrate_photographs
from registration.calibrate.options import CalibrateOptions
from registration.calibrate.result import Calibration
from registration.capture.native import read_capture
from registration.capture.scan import read_scan
from registration.geometry.rigid import similarity_transform
from registration.types import Capture

POINTS, SEED = 500, 0


def compare(calibration: Calibration, capture: Capture) -> tuple[float, dict[str, float]]:
    """Return the scale of the estimated world against the true one, and the rms error of each view, px.

    The similarity transform that brings the estimated cameras' projections of the scan's points nearest to the true
    ones is found by least squares. True distortion is left out on both sides.
    """
    assert capture.scan is not None
    vertices = read_scan(capture.scan).vertices
    points = np.random.default_rng(SEED).choice(vertices, min(POINTS, len(vertices)), replace=False).astype(np.float64)
    true = {view.name: view.camera for view in capture.views}
    found = calibration.cameras
    names = [name for name in found if name in true]
    expected = np.stack([true[name].project(points)[0] for name in names])

    def projected(x: np.ndarray) -> np.ndarray:
        moved = np.exp(x[0]) * points @ Rotation.from_rotvec(x[1:4]).as_matrix().T + x[4:7]
        return np.stack([found[name].project(moved)[0] for name in names])

    centres = [np.stack([cameras[name].centre for name in names]) for cameras in (true, found)]
    axes = [np.stack([cameras[name].T_cam_world[2, :3] for name in names]) for cameras in (true, found)]
    ends = [
        np.concatenate([c, c + np.linalg.norm(c, axis=1, keepdims=True) * a])
        for c, a in zip(centres, axes, strict=True)
    ]
    scale, rotation, shift = similarity_transform(*ends, free_scale=True)
    start = np.concatenate([[np.log(scale)], Rotation.from_matrix(rotation).as_rotvec(), shift])
    best = least_squares(lambda x: (projected(x) - expected).ravel(), start, x_scale="jac").x
    squared = ((projected(best) - expected) ** 2).sum(-1).mean(1)
    return float(np.exp(best[0])), dict(zip(names, np.sqrt(squared).tolist(), strict=True))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("captures", nargs="+", type=Path)
    parser.add_argument("--model", type=Path, required=True)
    parser.add_argument("--views", type=int, help="so many views only, evenly spread")
    parser.add_argument("--focal-px", type=float)
    parser.add_argument("--focal-spread", type=float, default=0.02)
    parser.add_argument("--distortion", action="store_true")
    parser.add_argument("--distance-of-cameras", action="store_true", help="the true one of first and last gives scale")
    arguments = parser.parse_args()
    options = CalibrateOptions(
        focal_px=arguments.focal_px, distortion=arguments.distortion, focal_spread=arguments.focal_spread
    )
    print("capture                    views  rms px  worst px  scale   stated  focal / true       s")
    for root in arguments.captures:
        capture = read_capture(root)
        views = capture.views
        if arguments.views:
            views = tuple(views[i] for i in np.unique(np.linspace(0, len(views) - 1, arguments.views).astype(int)))
        if arguments.distance_of_cameras:
            a, b = views[0], views[-1]
            metres = float(np.linalg.norm(a.camera.centre - b.camera.centre))
            options = replace(options, camera_distance=(a.image.stem, b.image.stem, metres))
        start = time.perf_counter()
        result = calibrate_photographs([view.image for view in views], arguments.model, options)
        seconds = time.perf_counter() - start
        scale, errors = compare(result, capture)
        rms = np.sqrt(np.mean(np.square(list(errors.values()))))
        worst = max(errors, key=lambda name: errors[name])
        focal = np.mean([camera.intrinsics[0, 0] for camera in result.cameras.values()])
        true = np.mean([view.camera.intrinsics[0, 0] for view in views])
        name = f"{root.parent.name}/{root.name}"[-26:]
        print(
            f"{name:26} {len(errors):2}/{len(views):2} {rms:7.2f} {errors[worst]:6.2f} {worst[-8:]:8} {scale:6.4f} "
            f"{result.size.sigma:6.3f} {focal:7.1f} {true:7.1f} {seconds:6.1f}",
            flush=True,
        )
        for name, reason in result.left_out.items():
            print(f"  left out: {name}: {reason}")
        for note in result.notes:
            print(f"  note: {note}")


if __name__ == "__main__":
    main()
