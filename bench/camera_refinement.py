"""Register captures whose cameras are wrong by known amounts, with and without their correction; print a table.

    python -m bench.camera_refinement [--case NAME ...] [--px 1.0] [--recipe draft] [--views N] [--photographs]
                                      [--capture DIR] [--model FILE]

Cases (all by default): exact cameras with a sigma of 0 and of `--px`; cameras off by `--px`, each by a random motion
and focal factor (`registration.degrading.degradation.perturbed_camera`), with 0 and `--px`; focal lengths off by
0.3 %, either way at random, with `--px`. `--photographs`: without normals and labels. The scan is only measured.

Distances are those of `gnmreg evaluate`, of the scan's face from the mesh, mean and median, mm. What all cameras share
moves the head and no image, so that they are given after a rigid alignment of the mesh to the scan's face too. The last
columns are the rms shift of the head in the images between the rig and the true one, px, but for a similarity.
"""

import argparse
import tempfile
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float
from rich.console import Console
from rich.table import Table

from bench.support.cameras import rig_errors_px, write_capture_with_cameras
from registration.capture.native import read_capture
from registration.capture.scan import read_scan
from registration.degrading.degradation import perturbed_camera
from registration.evaluate.evaluation import evaluate_registration
from registration.geometry.closest_point import barycentric_points, closest_points
from registration.geometry.rigid import align
from registration.options import RegisterOptions
from registration.pipeline import register
from registration.types import Camera, Capture, Registration

SHARED = Path(__file__).resolve().parent.parent.parent / "shared" / "data"
FOCAL_ERROR = 0.003
_ALIGNED_WITHIN_MM = 2.0  # distance of the scan's points that take part in the alignment
_ROUNDS = 12  # of alignment


@dataclass(frozen=True, kw_only=True)
class Case:
    """Errors of the cameras, and what is stated about them."""

    error: str  # "exact", "pose" or "focal"
    stated: bool


CASES: Mapping[str, Case] = {
    "exact": Case(error="exact", stated=False),
    "exact, sigma stated": Case(error="exact", stated=True),
    "pose": Case(error="pose", stated=False),
    "pose, sigma stated": Case(error="pose", stated=True),
    "focal, sigma stated": Case(error="focal", stated=True),
}


def wrong_cameras(capture: Capture, error: str, px: float, seed: int) -> dict[str, Camera]:
    """The capture's cameras with errors, by view."""
    assert capture.scan is not None
    points, cameras = read_scan(capture.scan).vertices[::10], {}
    for number, view in enumerate(capture.views):
        rng, camera = np.random.default_rng([seed, number]), view.camera
        if error == "pose":
            camera = perturbed_camera(camera, points, px, rng)
        elif error == "focal":
            intrinsics = camera.intrinsics.copy()
            intrinsics[[0, 1], [0, 1]] *= 1 + FOCAL_ERROR * rng.choice([-1, 1])
            camera = replace(camera, intrinsics=intrinsics)
        cameras[view.name] = camera
    return cameras


def distances_mm(registration: Registration, capture: Capture) -> tuple[float, float, float, float]:
    """Mean and median distance of the scan's face from the mesh, as it is and after a rigid alignment."""
    evaluation = evaluate_registration(registration, capture)
    chosen = evaluation.scan_face & (evaluation.scan_distance_mm < _ALIGNED_WITHIN_MM)
    points, vertices = evaluation.scan.vertices[chosen], registration.vertices.astype(np.float64)
    for _ in range(_ROUNDS):
        _, face, weights = closest_points(points, vertices, registration.triangles)
        closest = barycentric_points(vertices, registration.triangles, face, weights)
        transform = align(closest[None], points, np.ones((1, len(points))))[0]
        vertices = vertices @ transform[:3, :3].T + transform[:3, 3]
    aligned = evaluate_registration(replace(registration, vertices=vertices.astype(np.float32)), capture)
    rows = [result.metrics["scan_to_mesh"]["face"] for result in (evaluation, aligned)]
    return rows[0]["mean_mm"], rows[0]["median_mm"], rows[1]["mean_mm"], rows[1]["median_mm"]


def corrected_cameras(registration: Registration, cameras: Sequence[Camera], names: Sequence[str]) -> list[Camera]:
    """The cameras that a fit ended with."""
    views = registration.figures.get("cameras", {}).get("views", {})
    return [
        camera
        if name not in views
        else replace(
            camera,
            T_cam_world=np.array(views[name]["T_cam_world"]),
            intrinsics=np.array(views[name]["intrinsics"]),
        )
        for name, camera in zip(names, cameras, strict=True)
    ]


def row(name: str, capture: Capture, arguments: argparse.Namespace, folder: Path) -> list[str]:
    """Register one case, and return its row of the table."""
    case = CASES[name]
    cameras = wrong_cameras(capture, case.error, arguments.px, arguments.seed)
    root = folder / name.replace(" ", "_").replace(",", "")
    write_capture_with_cameras(capture, root, cameras, geometry=not arguments.photographs)
    options = RegisterOptions(
        recipe=arguments.recipe,
        views=arguments.views,
        use_scan="never",
        detect=False,
        stereo=False,
        camera_sigma_px=arguments.px if case.stated else 0.0,
    )
    start = time.perf_counter()
    result = register(root, arguments.model, folder / f"{root.name}_result", options)
    seconds = time.perf_counter() - start
    used = [view for view in capture.views if view.name in result.config["views"]]
    names, true = [view.name for view in used], [view.camera for view in used]
    given = [cameras[view] for view in names]
    points: Float[np.ndarray, "P 3"] = result.vertices[result.confidence > 0.3].astype(np.float64)
    errors = [
        float(np.sqrt(np.square(rig_errors_px(rig, true, points)).mean()))
        for rig in (given, corrected_cameras(result, given, names))
    ]
    raw_mean, raw_median, mean, median = distances_mm(result, capture)
    numbers = [f"{raw_mean:.3f} / {raw_median:.3f}", f"{mean:.3f} / {median:.3f}"]
    return [name, result.status, *numbers, *(f"{error:.2f}" for error in errors), f"{seconds:.0f}"]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--case", nargs="*", choices=CASES, default=list(CASES))
    parser.add_argument("--px", type=float, default=1.0)
    parser.add_argument("--recipe", default="draft")
    parser.add_argument("--views", type=int)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--photographs", action="store_true")
    parser.add_argument("--capture", type=Path, default=SHARED / "captures" / "ict_dev" / "neutral")
    parser.add_argument("--model", type=Path, default=SHARED / "gnm" / "gnm_head_reconstructed.npz")
    arguments = parser.parse_args()
    table = Table("cameras", "status", "scan to mesh, mm", "aligned, mm", "px off", "px left", "s")
    capture = read_capture(arguments.capture)
    with tempfile.TemporaryDirectory() as folder:
        for name in arguments.case:
            table.add_row(*row(name, capture, arguments, Path(folder)))
    Console().print(table)


if __name__ == "__main__":
    main()
