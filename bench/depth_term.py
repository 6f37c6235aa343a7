"""Register captures whose normals, depths and confidences are those of their scans, with the errors of stereo.

    python -m bench.depth_term --model MODEL.npz CAPTURE... [--recipe draft] [--errors noisy] [--without segmentation]

Each capture is copied with rendered maps in place of its `normals`. The scan is only measured: all views have normals,
in the row `depth` those of the depth maps.
"""

import argparse
import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from rich.console import Console
from rich.table import Table

from bench.support.stereo_errors import CLEAN, StereoErrors, with_stereo
from registration.capture.native import read_capture
from registration.evaluate.evaluation import evaluate_registration
from registration.storage.registration_folder import load_registration

ERRORS = {"clean": CLEAN, "noisy": StereoErrors()}
GIVEN = {"normals": ("normals", "confidence"), "depth": ("depth", "confidence")}
GIVEN["both"] = ("normals", "depth", "confidence")


def measure(source: Path, errors: str, given: str, options: argparse.Namespace) -> tuple[str, ...]:
    """Register a capture with some maps; status, seconds and distances."""
    with tempfile.TemporaryDirectory() as folder:
        target, out = Path(folder) / "capture", Path(folder) / "out"
        with_stereo(source, target, ERRORS[errors], without=tuple(options.without), parts=GIVEN[given])
        command = [sys.executable, "-m", "workflows.cli", "register", str(target), "--model", str(options.model)]
        command += ["--out", str(out), "--recipe", options.recipe, "--use-scan", "never"]
        start = time.perf_counter()
        ran = subprocess.run(command, capture_output=True, text=True, check=False)
        seconds = time.perf_counter() - start
        if not (out / "manifest.json").is_file():
            return ("refused", ran.stderr.strip().splitlines()[-1])
        manifest = json.loads((out / "manifest.json").read_text(encoding="utf-8"))
        evaluation = evaluate_registration(load_registration(out), read_capture(source))
    face = evaluation.metrics["scan_to_mesh"]["face"]
    truth = evaluation.metrics.get("vertex_error", {}).get("face", {}).get("mean_mm")
    residual = manifest["figures"]["residuals"]["overall"].get("depth_mm")
    numbers = (*(face[key] for key in ("mean_mm", "median_mm", "p95_mm")), truth, residual)
    cells = ("-" if number is None else f"{number:.3f}" for number in numbers)
    return (manifest["status"], f"{seconds:.0f}", *cells)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("captures", nargs="+", type=Path, metavar="CAPTURE")
    parser.add_argument("--model", required=True, type=Path, metavar="NPZ")
    parser.add_argument("--recipe", default="draft")
    parser.add_argument("--errors", nargs="+", choices=ERRORS, default=list(ERRORS))
    parser.add_argument("--given", nargs="+", choices=GIVEN, default=list(GIVEN))
    parser.add_argument("--without", nargs="*", default=[], choices=("segmentation", "masks", "landmarks"))
    options = parser.parse_args()
    heads = ("capture", "maps", "given", "status", "s", "face mean mm", "median", "p95", "vertex error mm", "depth mm")
    left_out = f", without {' and '.join(options.without)}" if options.without else ""
    table = Table(*heads, title=f"{options.recipe}{left_out}; scan to mesh on the face")
    for capture in options.captures:
        for errors in options.errors:
            for given in options.given:
                name = "/".join(capture.resolve().parts[-2:])
                table.add_row(name, errors, given, *measure(capture, errors, given, options))
    Console(width=140).print(table)


if __name__ == "__main__":
    main()
