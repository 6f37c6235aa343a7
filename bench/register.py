"""Register captures and print accuracy, time and memory; the results are not kept.

    python -m bench.register --model MODEL.npz CAPTURE... [--recipe draft]

Each capture is registered in a separate process, so that its memory peak can be measured; seconds are those of the
whole command.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table


@dataclass(frozen=True, kw_only=True)
class Measured:
    """Cost and manifest of one registration."""

    seconds: float
    peak_gb: float
    manifest: dict[str, Any]  # empty if nothing was written
    error: str

    @property
    def row(self) -> tuple[str, ...]:
        """Return the table's cells after the capture's name."""
        figures = self.manifest.get("figures", {})
        scan = figures.get("scan_to_mesh", {}).get("face", {})
        truth = figures.get("vertex_error", {}).get("face", {})
        numbers = (scan.get("mean_mm"), scan.get("median_mm"), scan.get("p95_mm"), truth.get("mean_mm"))
        return (
            self.manifest.get("status", "refused"),
            f"{self.seconds:.0f}",
            *("-" if number is None else f"{number:.3f}" for number in numbers),
            f"{self.peak_gb:.2f}",
        )


def measure(capture: Path, model: Path, recipe: str) -> Measured:
    with tempfile.TemporaryDirectory() as folder:
        out, log = Path(folder) / "out", Path(folder) / "log"
        command = [sys.executable, "-m", "workflows.cli", "register", str(capture), "--model", str(model)]
        start = time.perf_counter()
        with log.open("w") as stream:
            process = subprocess.Popen(
                [*command, "--out", str(out), "--recipe", recipe], stdout=stream, stderr=subprocess.STDOUT
            )
            usage = os.wait4(process.pid, 0)[2]  # of this process alone; subprocess does not report it
        seconds = time.perf_counter() - start
        manifest = out / "manifest.json"
        return Measured(
            seconds=seconds,
            peak_gb=usage.ru_maxrss * 1024 / 1e9,
            manifest=json.loads(manifest.read_text()) if manifest.is_file() else {},
            error="" if manifest.is_file() else log.read_text().strip(),
        )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("captures", nargs="+", type=Path, metavar="CAPTURE")
    parser.add_argument("--model", required=True, type=Path, metavar="NPZ")
    parser.add_argument("--recipe", default="draft")
    options = parser.parse_args()
    heads = ("capture", "status", "s", "face mean mm", "median", "p95", "vertex error mm", "peak GB")
    table = Table(*heads, title=f"{options.recipe}, {os.cpu_count()} cores; scan to mesh and vertex error on the face")
    errors = Console(stderr=True)
    for capture in options.captures:
        measured = measure(capture, options.model, options.recipe)
        table.add_row("/".join(capture.resolve().parts[-2:]), *measured.row)
        if measured.error:
            errors.print(measured.error, markup=False)
    Console(width=120).print(table)


if __name__ == "__main__":
    main()
