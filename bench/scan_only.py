"""Register scans without photographs, and beside it trimesh's non-rigid ICP on the same input; print a table.

    python -m bench.scan_only [--case NAME ...] [--recipe draft] [--seconds 300] [--no-nricp] [--captures DIR]

Cases, of the captures in DIR and with DIR/../gnm/gnm_head_reconstructed.npz:

ict_68      ict_dev/neutral/scan.ply with its 68 landmarks, triangulated from the capture's views
ict_bare    the same scan without landmarks
real_68     real_two_view/neutral/scan.ply with hand_marked_68.npz

Ours is `gnmreg register --scan`, started as a command and ended after `--seconds`; processor seconds are of all of
its threads. The other is `trimesh.registration.nricp_amberg` with its default steps: from the model's template at the
pose that `registration.scan_capture.placement` finds (it has no search of its own), its visible skin without the inner
parts, with the same landmarks. Its closest points come from this project's tree, which returns the same points as
trimesh's own, faster and without rtree; it is ended after `--seconds` too. Distances are those that `gnmreg evaluate`
reports: of the vertices of the scan's face, as the capture's own cameras see it, from the mesh; millimetres.
"""

import argparse
import multiprocessing
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from registration.capture.native import read_capture
from registration.capture.scan import read_scan_file
from registration.capture.triangulation import triangulate
from registration.evaluate.evaluation import evaluate_registration
from registration.geometry.closest_point import ClosestPointQuery, barycentric_points
from registration.inputs import read_schemes
from registration.model import gnm_npz, regions
from registration.scan_capture.hygiene import clean
from registration.scan_capture.placement import UNITS_M, Search
from registration.storage.registration_folder import load_registration
from registration.types import Capture, Registration

CAPTURES = Path(__file__).resolve().parent.parent.parent / "shared" / "data" / "captures"


@dataclass(frozen=True, kw_only=True)
class Case:
    """A scan, and where its landmarks come from."""

    capture: str
    landmarks: str | None  # "views": triangulated; else a file of the capture
    wanted_mm: float  # mean distance on the face


CASES: Mapping[str, Case] = {
    "ict_68": Case(capture="ict_dev/neutral", landmarks="views", wanted_mm=0.25),
    "ict_bare": Case(capture="ict_dev/neutral", landmarks=None, wanted_mm=0.35),
    "real_68": Case(capture="real_two_view/neutral", landmarks="hand_marked_68.npz", wanted_mm=0.4),
}


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """One method on one case."""

    mean_mm: float | None
    median_mm: float | None
    p95_mm: float | None
    seconds: float
    cpu_seconds: float | None
    said: str


def landmark_file(case: Case, capture: Capture, folder: Path) -> Path | None:
    """The case's landmarks in the scan's frame."""
    if case.landmarks is None:
        return None
    if case.landmarks != "views":
        return capture.root / case.landmarks
    file = folder / "landmarks.npz"
    np.savez(file, points=triangulate(capture, "68")[0])
    return file


def measured(registration: Registration, capture: Capture) -> dict[str, float | None]:
    """The figures of the scan's face."""
    face: Mapping[str, Any] = evaluate_registration(registration, capture).metrics["scan_to_mesh"]["face"]
    return {name: face[name] for name in ("mean_mm", "median_mm", "p95_mm")}


def ours(case: Case, capture: Capture, model: Path, recipe: str, limit: float, folder: Path) -> Outcome:
    """Run the command."""
    assert capture.scan is not None
    out = folder / "registration"
    words = [sys.executable, "-m", "workflows.cli", "register", "--scan", str(capture.scan), "--model", str(model)]
    words += ["--out", str(out), "--recipe", recipe]
    if (file := landmark_file(case, capture, folder)) is not None:
        words += ["--scan-landmarks", str(file)]
    before, start = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    try:
        done = subprocess.run(words, capture_output=True, text=True, timeout=limit)
    except subprocess.TimeoutExpired:
        return _unfinished(time.perf_counter() - start)
    seconds, after = time.perf_counter() - start, resource.getrusage(resource.RUSAGE_CHILDREN)
    cpu = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    if not (out / "manifest.json").is_file():
        said = (done.stderr or done.stdout).strip()[-300:]
        return replace(_unfinished(seconds), said=said)
    registration = load_registration(out)
    hygiene = registration.figures["scan_hygiene"]
    said = f"{registration.status}; {hygiene['counted_area']:.0%} of the scan gives normals"
    return Outcome(**measured(registration, capture), seconds=seconds, cpu_seconds=cpu, said=said)


def theirs(case: Case, capture: Capture, model: Path, template: Registration, limit: float, folder: Path) -> Outcome:
    """Run nricp_amberg in a process of its own."""
    result = folder / "nricp.npy"
    landmarks = landmark_file(case, capture, folder)
    process = multiprocessing.get_context("spawn").Process(target=_nricp, args=(capture.scan, landmarks, model, result))
    start = time.perf_counter()
    process.start()
    process.join(limit)
    seconds = time.perf_counter() - start
    if process.is_alive():
        process.terminate()
        process.join()
        return _unfinished(seconds)
    if not result.is_file():
        return replace(_unfinished(seconds), said="it failed")
    registration = replace(template, vertices=np.load(result).astype(np.float32))
    return Outcome(**measured(registration, capture), seconds=seconds, cpu_seconds=None, said="nricp_amberg, defaults")


def _unfinished(seconds: float) -> Outcome:
    return Outcome(
        mean_mm=None, median_mm=None, p95_mm=None, seconds=seconds, cpu_seconds=None, said="ended at the time limit"
    )


def _nricp(scan_file: Path, landmarks: Path | None, model: Path, result: Path) -> None:
    """Write the model's vertices after trimesh's non-rigid ICP of the visible skin."""
    import trimesh

    class Tree:
        """Closest points of the target by this project's tree."""

        def __init__(self) -> None:
            self.query: ClosestPointQuery | None = None

        def __call__(self, mesh: trimesh.Trimesh, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
            vertices, faces = np.asarray(mesh.vertices), np.asarray(mesh.faces)
            self.query = self.query or ClosestPointQuery(vertices, faces)
            distance, face, barycentric = self.query.closest(points)
            return barycentric_points(vertices, faces, face, barycentric), distance, face

    trimesh.proximity.closest_point = Tree()
    data = gnm_npz.read(model)
    scheme = read_schemes(model, data, {})["68"]
    raw, _ = clean(read_scan_file(scan_file), scan_file)
    search = Search(raw, data, scan_file)
    points = None if landmarks is None else np.load(landmarks)["points"]
    placed = search.without_landmarks(None) if points is None else search.from_landmarks(points, scheme, data, None)
    similarity = replace(placed.placement, coefficients=None)
    vertices = similarity.mesh(placed.sample, data)
    faces = data.triangles[regions.exterior(data)[data.triangles].all(1)]
    used = np.unique(faces)
    place = np.full(len(vertices), -1)
    place[used] = np.arange(len(used))
    source = trimesh.Trimesh(vertices[used], place[faces], process=False)
    target = trimesh.Trimesh(raw.vertices * UNITS_M[placed.unit], raw.triangles, process=False)
    arguments: dict[str, Any] = {}
    if points is not None:
        strongest = scheme.indices[np.arange(len(scheme.indices)), scheme.weights.argmax(1)]
        given = np.isfinite(points).all(1) & (place[strongest] >= 0)
        arguments = {"source_landmarks": place[strongest[given]], "target_positions": points[given]}
    vertices[used] = trimesh.registration.nricp_amberg(source, target, distance_threshold=0.02, **arguments)
    np.save(result, vertices)


def main() -> int:
    """Run the cases; 1 if one of ours misses its mark."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--case", nargs="+", choices=[*CASES], default=[*CASES])
    parser.add_argument("--recipe", default="draft", help="of ours")
    parser.add_argument("--seconds", type=float, default=300, help="limit of each run")
    parser.add_argument("--no-nricp", action="store_true", help="ours alone")
    parser.add_argument("--captures", type=Path, default=CAPTURES, metavar="DIR")
    options = parser.parse_args()
    model = options.captures.parent / "gnm" / "gnm_head_reconstructed.npz"
    table = Table("case", "method", "mean", "median", "p95", "wanted", "wall s", "cpu s", "")
    missed = 0
    for name in options.case:
        case = CASES[name]
        capture = read_capture(options.captures / case.capture)
        with tempfile.TemporaryDirectory(prefix="scan-only-") as temporary:
            folder = Path(temporary)
            mine = ours(case, capture, model, options.recipe, options.seconds, folder)
            missed += mine.mean_mm is None or mine.mean_mm > case.wanted_mm
            rows = [("gnmreg register --scan", mine)]
            if not options.no_nricp and mine.mean_mm is not None:
                template = load_registration(folder / "registration")
                rows.append(("trimesh nricp", theirs(case, capture, model, template, options.seconds, folder)))
        for method, outcome in rows:
            figures = [
                f"{v:.3f}" if v is not None else "-" for v in (outcome.mean_mm, outcome.median_mm, outcome.p95_mm)
            ]
            cpu = "-" if outcome.cpu_seconds is None else f"{outcome.cpu_seconds:.0f}"
            wanted = f"<= {case.wanted_mm}" if outcome is mine else ""
            table.add_row(name, method, *figures, wanted, f"{outcome.seconds:.0f}", cpu, outcome.said)
            print(f"{name}, {method}: mean {figures[0]} mm, {outcome.seconds:.0f} s, {outcome.said}", flush=True)
    Console(width=150).print(table, markup=False)
    return 1 if missed else 0


if __name__ == "__main__":
    sys.exit(main())
