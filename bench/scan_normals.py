"""Register captures with scans in place of their normal and label maps, also with damaged scans.

    python -m bench.scan_normals --model MODEL.npz CAPTURE... [--recipe draft] [--variants scan damaged]

Each capture is copied without `normals` and `segmentation`. Distances are those of the whole scan, as
`gnmreg evaluate` reports them, and the vertex error where the ground truth has the model's topology. Of a damaged scan
holes are cut out of the face, and what is above the brows is raised by a centimetre or two, as hair would be that the
images do not show. The last columns are mean distances of the face away from both, at the holes, and under the hair.
"""

import argparse
import json
import shutil
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float
from rich.console import Console
from rich.table import Table
from scipy.spatial import cKDTree

from registration.capture.native import read_capture
from registration.capture.scan import Scan, read_scan
from registration.capture.triangulation import triangulate
from registration.evaluate.evaluation import evaluate_registration
from registration.geometry.smoothstep import smoothstep
from registration.geometry.topology import vertex_normals
from registration.storage.mesh import write_ply
from registration.storage.registration_folder import load_registration
from registration.types import Capture

VARIANTS = {
    "scan": "the scan gives normals, and is fitted",
    "damaged": "the same with holes and hair in the scan",
    "cloud": "the scan's vertices alone, without faces",
    "never": "the scan is only measured",
}
_HOLES = (31, 8, 48, 39)  # landmarks beside which holes are cut: nose, chin, mouth, eye
_HOLE_M, _HAIR_M, _AWAY_M = 0.012, 0.015, 0.008


@dataclass(frozen=True, kw_only=True)
class Damage:
    """A damaged scan, and which vertices of the whole one the damage concerns."""

    scan: Scan
    holes: Bool[np.ndarray, "V"]
    hair: Bool[np.ndarray, "V"]
    elsewhere: Bool[np.ndarray, "V"]


def damaged(capture: Capture, scan: Scan) -> Damage:
    """Cut holes out of a scan's face and raise its scalp as hair would. The capture has the landmarks 68."""
    points = triangulate(capture, "68")[0]
    up = points[27] - points[33]
    up /= np.linalg.norm(up)
    near = [np.linalg.norm(scan.vertices - points[k], axis=1) < _HOLE_M for k in _HOLES]
    holes = np.any(near, axis=0)
    height = (scan.vertices - points[19:25].mean(0)) @ up
    raised = smoothstep(0.03, 0.04, height)
    faces = scan.triangles
    normals = vertex_normals(*(_tensor(values) for values in (scan.vertices, faces))).numpy()
    strands = 0.7 + 0.3 * np.random.default_rng(0).random(len(scan.vertices))
    vertices = scan.vertices + (raised * strands * _HAIR_M)[:, None] * normals
    kept = faces[~holes[faces].any(1)]
    away = cKDTree(scan.vertices[holes]).query(scan.vertices)[0] > _AWAY_M
    whole = Scan(vertices=vertices, triangles=kept)
    return Damage(scan=whole, holes=holes, hair=raised > 0, elsewhere=away & ~(raised > 0))


def _tensor(values: np.ndarray):  # noqa: ANN202  torch is imported only here
    import torch

    return torch.from_numpy(np.ascontiguousarray(values))


def without_maps(source: Path, target: Path, scan: Scan) -> None:
    """Copy a capture without normal and label maps, with another scan."""
    ignored = shutil.ignore_patterns("normals", "segmentation", "scan.*")
    shutil.copytree(source, target, ignore=ignored)
    settings = (target / "capture.toml").read_text(encoding="utf-8")
    (target / "capture.toml").write_text(settings.split("[segmentation]")[0], encoding="utf-8")
    write_ply(target / "scan.ply", scan.vertices, scan.triangles)


def measure(source: Path, variant: str, model: Path, recipe: str) -> tuple[str, ...]:
    """Register a variant of a capture; cells of the table after its name."""
    capture = read_capture(source)
    assert capture.scan is not None
    scan = read_scan(capture.scan)
    damage = damaged(capture, scan)
    fitted = damage.scan if variant == "damaged" else scan
    if variant == "cloud":
        fitted = Scan(vertices=scan.vertices, triangles=scan.triangles[:0])
    with tempfile.TemporaryDirectory() as folder:
        target, out = Path(folder) / "capture", Path(folder) / "out"
        without_maps(source, target, fitted)
        command = [sys.executable, "-m", "workflows.cli", "register", str(target), "--model", str(model)]
        command += ["--out", str(out), "--recipe", recipe, "--use-scan", "never" if variant == "never" else "auto"]
        start = time.perf_counter()
        ran = subprocess.run(command, capture_output=True, text=True, check=False)
        seconds = time.perf_counter() - start
        if not (out / "manifest.json").is_file():
            return ("refused", ran.stderr.strip().splitlines()[-1])
        status = json.loads((out / "manifest.json").read_text(encoding="utf-8"))["status"]
        evaluation = evaluate_registration(load_registration(out), capture)
    face = evaluation.metrics["scan_to_mesh"]["face"]
    truth = evaluation.metrics.get("vertex_error", {}).get("face", {})
    visible, distance = evaluation.scan_visible, evaluation.scan_distance_mm
    spots = (evaluation.scan_face & damage.elsewhere, visible & damage.holes, visible & damage.hair)
    numbers = (
        *(face[key] for key in ("mean_mm", "median_mm", "p95_mm")),
        truth.get("mean_mm"),
        *(_mean(distance, spot) for spot in spots),
    )
    return (status, f"{seconds:.0f}", *("-" if number is None else f"{number:.3f}" for number in numbers))


def _mean(values: Float[np.ndarray, "P"], chosen: Bool[np.ndarray, "P"]) -> float | None:
    return float(values[chosen].mean()) if chosen.any() else None


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("captures", nargs="+", type=Path, metavar="CAPTURE")
    parser.add_argument("--model", required=True, type=Path, metavar="NPZ")
    parser.add_argument("--recipe", default="draft")
    parser.add_argument("--variants", nargs="+", choices=VARIANTS, default=["scan", "damaged"])
    options = parser.parse_args()
    heads = (
        "capture",
        "variant",
        "status",
        "s",
        "face mean mm",
        "median",
        "p95",
        "vertex error mm",
        "elsewhere",
        "holes",
        "hair",
    )
    table = Table(*heads, title=f"{options.recipe}, without normal and label maps; scan to mesh on the face")
    for capture in options.captures:
        for variant in options.variants:
            name = "/".join(capture.resolve().parts[-2:])
            table.add_row(name, variant, *measure(capture, variant, options.model, options.recipe))
    Console(width=160).print(table)


if __name__ == "__main__":
    main()
