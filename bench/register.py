"""Register captures and print accuracy, cost and memory; the results are not kept.

    python -m bench.register --model MODEL.npz CAPTURE... [--recipe draft preview] [--repeats 5] [--sources CHECKOUT...]

Each capture is registered in a separate process, so that its memory peak can be measured; seconds are those of the
whole command, CPU seconds of all its threads. With `--repeats` every cell is a median. `--sources` compares versions:
the root folders of checkouts, each registered from in turn within every repeat, so that the machine's other work falls
on all alike.
"""

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

_HERE = Path(__file__).parents[1]


@dataclass(frozen=True, kw_only=True)
class Measured:
    """Cost and manifest of one registration."""

    seconds: float
    cpu_seconds: float
    peak_gb: float
    manifest: dict[str, Any]  # empty if nothing was written
    error: str

    @property
    def status(self) -> str:
        """Return the manifest's status."""
        return self.manifest.get("status", "refused")

    @property
    def numbers(self) -> tuple[float | None, ...]:
        """Return the table's numbers; None: this registration has none."""
        figures = self.manifest.get("figures", {})
        scan = figures.get("scan_to_mesh", {}).get("face", {})
        truth = figures.get("vertex_error", {}).get("face", {})
        return (
            self.seconds,
            self.cpu_seconds,
            scan.get("mean_mm"),
            scan.get("median_mm"),
            scan.get("p95_mm"),
            truth.get("mean_mm"),
            figures.get("folds", {}).get("edges"),
            self.peak_gb,
        )


def measure(capture: Path, model: Path, recipe: str, sources: Path) -> Measured:
    """Register one capture in a process of its own, with the code of a checkout."""
    with tempfile.TemporaryDirectory() as folder:
        out, log = Path(folder) / "out", Path(folder) / "log"
        command = [sys.executable, "-m", "workflows.cli", "register", str(capture), "--model", str(model)]
        path = os.pathsep.join([str(sources), *filter(None, [os.environ.get("PYTHONPATH")])])
        start = time.perf_counter()
        with log.open("w") as stream:
            process = subprocess.Popen(
                [*command, "--out", str(out), "--recipe", recipe],
                stdout=stream,
                stderr=subprocess.STDOUT,
                cwd=folder,
                env={**os.environ, "PYTHONPATH": path},
            )
            usage = os.wait4(process.pid, 0)[2]  # of this process alone; subprocess does not report it
        seconds = time.perf_counter() - start
        manifest = out / "manifest.json"
        return Measured(
            seconds=seconds,
            cpu_seconds=usage.ru_utime + usage.ru_stime,
            peak_gb=usage.ru_maxrss * 1024 / 1e9,
            manifest=json.loads(manifest.read_text()) if manifest.is_file() else {},
            error="" if manifest.is_file() else log.read_text().strip(),
        )


def cells(repeats: Sequence[Measured]) -> list[str]:
    """Return the medians of a registration's repeats."""
    status = sorted({measured.status for measured in repeats})
    formats = (".0f", ".0f", ".3f", ".3f", ".3f", ".3f", ".0f", ".2f")
    columns = zip(*(measured.numbers for measured in repeats), strict=True)
    known = ([number for number in column if number is not None] for column in columns)
    medians = (
        format(statistics.median(numbers), style) if numbers else "-"
        for numbers, style in zip(known, formats, strict=True)
    )
    return [", ".join(status), *medians]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("captures", nargs="+", type=Path, metavar="CAPTURE")
    parser.add_argument("--model", required=True, type=Path, metavar="NPZ")
    parser.add_argument("--recipe", nargs="+", default=["draft"])
    parser.add_argument("--repeats", type=int, default=1)
    parser.add_argument("--sources", nargs="+", type=Path, default=[_HERE], metavar="CHECKOUT")
    options = parser.parse_args()
    if options.repeats < 1:
        parser.error(f"--repeats must be 1 or more, not {options.repeats}")
    for sources in options.sources:  # else the installed version would be measured in its place
        if not (sources / "workflows" / "cli").is_dir():
            parser.error(f"--sources {sources} is no root folder of a checkout: it has no workflows/cli")
    heads = ("capture", "recipe", "sources", "status", "s", "CPU s", "face, mm", "median", "p95", "vertices", "folds")
    title = f"medians of {options.repeats}, {os.cpu_count()} cores; scan to mesh and vertex error on the face"
    table, errors = Table(*heads, "peak GB", title=title), Console(stderr=True)
    for capture in (capture.resolve() for capture in options.captures):
        for recipe in options.recipe:
            runs: dict[Path, list[Measured]] = {sources.resolve(): [] for sources in options.sources}
            for _ in range(options.repeats):
                for sources, repeats in runs.items():
                    repeats.append(measure(capture, options.model.resolve(), recipe, sources))
                    cpu_seconds = repeats[-1].cpu_seconds
                    errors.print(f"{'/'.join(capture.parts[-2:])} {recipe} {sources.name}: {cpu_seconds:.0f} CPU s")
                    if repeats[-1].error:
                        errors.print(repeats[-1].error, markup=False)
            for sources, repeats in runs.items():
                table.add_row("/".join(capture.parts[-2:]), recipe, sources.name, *cells(repeats))
    Console(width=140).print(table)


if __name__ == "__main__":
    main()
