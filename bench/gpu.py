"""Test and measure everything that runs on a GPU, in one run of eight minutes, and print one table.

    python -m bench.gpu OUT --prepare [--python 3.12] [--without torch]
    python -m bench.gpu OUT [--variant cuda|llvm] [--minutes 8]

`--prepare` collects in OUT what a machine without a network needs: the wheels of the package and of the tests for that
Python, the first model, a synthetic capture of 22 views of 480 x 720 px, and `install.sh`. `--without` names packages
that the machine has already. Then OUT and the source are copied to it, and the second command measures: the device,
the tests marked `cuda`, the renderer against the ray cast, a `draft` and a `studio` registration, and a `draft` on the
CPU to compare with. A part that exceeds the time left is ended and reported as such. Each part's output is in OUT.
`--variant llvm` runs the same parts on the CPU.
"""

import argparse
import json
import os
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from rich.console import Console
from rich.table import Table

from bench.support import offline_bundle

ROOT = Path(__file__).resolve().parents[1]
RENDERER_CASES = ("22x512", "8x512")
CAPTURE = Path("dataset", "synth_0000", "neutral")
MODEL = Path("model", "gnm_head_first.npz")


@dataclass(kw_only=True)
class Part:
    """One command of the benchmark and what became of it."""

    name: str
    command: list[str]
    figures: Callable[[str], str]  # of the command's output
    outcome: str = ""
    seconds: float = 0.0
    gpu_gb: float = 0.0

    def run(self, out: Path, seconds: float) -> None:
        """Run the command for at most `seconds`, its output into OUT/NAME.log."""
        log = out / f"{self.name.replace(' ', '_')}.log"
        start = time.perf_counter()
        with log.open("w") as stream, GpuMemory() as memory:
            process = subprocess.Popen(
                self.command, cwd=ROOT, stdout=stream, stderr=subprocess.STDOUT, start_new_session=True
            )
            try:
                code = process.wait(max(seconds, 0.1))
            except subprocess.TimeoutExpired:
                os.killpg(process.pid, signal.SIGKILL)
                process.wait()
                code = None
        self.seconds, self.gpu_gb = time.perf_counter() - start, memory.peak_gb
        text = log.read_text("utf-8", "replace")
        last = text.strip().splitlines()[-1:] or ["no output"]
        if code is None:
            self.outcome = f"stopped after {self.seconds:.0f} s: no time left"
        else:
            self.outcome = self.figures(text) if code == 0 else f"failed ({code}): {last[0]}"


class GpuMemory:
    """The largest memory in use on the first GPU while it is open, of all processes; 0 without a GPU."""

    def __init__(self) -> None:
        self.peak_gb = 0.0
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._watch, daemon=True)

    def __enter__(self) -> "GpuMemory":
        if shutil.which("nvidia-smi"):
            self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._ended.set()
        if self._thread.is_alive():
            self._thread.join()

    def _watch(self) -> None:
        while not self._ended.wait(0.5):
            mebibytes = nvidia("memory.used")
            self.peak_gb = max(self.peak_gb, float(mebibytes or 0) * 2**20 / 1e9)


def nvidia(query: str) -> str:
    """Return what nvidia-smi says of the first GPU, or nothing."""
    command = ["nvidia-smi", f"--query-gpu={query}", "--format=csv,noheader,nounits", "--id=0"]
    done = subprocess.run(command, capture_output=True, text=True)
    return done.stdout.strip() if done.returncode == 0 else ""


def prepare(out: Path, python: str, without: list[str]) -> None:
    """Collect wheels, the first model and a capture in `out`."""
    offline_bundle.make(out, python, without)
    gnmreg = [sys.executable, "-m", "workflows.cli"]
    subprocess.run([*gnmreg, "model", "bootstrap", "--out", str(out / MODEL)], check=True)
    subprocess.run([*gnmreg, "dataset", "synth", str(out / "dataset"), "--subjects", "1"], check=True)


def parts(out: Path, variant: str) -> list[Part]:
    python = [sys.executable, "-m"]
    tests = [str(file) for file in sorted((ROOT / "tests").rglob("test_*.py")) if "mark.cuda" in file.read_text()]
    cases = [word for case in RENDERER_CASES for word in ("--case", case)]

    def register(recipe: str, on: str) -> Part:
        folder = out / f"{recipe}_{on}"
        shutil.rmtree(folder, ignore_errors=True)
        command = [*python, "workflows.cli", "register", str(out / CAPTURE), "--model", str(out / MODEL)]
        return Part(
            name=f"{recipe} {on}",
            command=[*command, "--out", str(folder), "--recipe", recipe, "--variant", on],
            figures=lambda _: accuracy(folder / "manifest.json"),
        )

    return [
        Part(
            name="tests",
            command=[*python, "pytest", "-q", "-m", "cuda", "-p", "no:cacheprovider", *tests],
            figures=lambda text: text.strip().splitlines()[-1].strip("= "),
        ),
        Part(
            name="renderer",
            command=[*python, "bench.renderer", "--variant", variant, *cases],
            figures=lambda text: ", ".join(line for line in text.splitlines() if line.startswith(("ratio", "misses"))),
        ),
        register("draft", variant),
        register("studio", variant),
        *([register("draft", "llvm")] if variant == "cuda" else []),
    ]


def accuracy(manifest: Path) -> str:
    record = json.loads(manifest.read_text("utf-8"))
    truth = record["figures"].get("vertex_error", {}).get("face", {}).get("mean_mm")
    return f"{record['status']}" + ("" if truth is None else f", vertex error of the face {truth:.3f} mm")


def device(variant: str) -> str:
    if variant == "llvm":
        return f"{os.cpu_count()} cores"
    return nvidia("name,driver_version,memory.total") or "no GPU that nvidia-smi sees"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path, metavar="OUT")
    parser.add_argument("--prepare", action="store_true")
    parser.add_argument("--python", default=f"{sys.version_info.major}.{sys.version_info.minor}", metavar="X.Y")
    parser.add_argument("--without", nargs="*", default=[], metavar="PACKAGE")
    parser.add_argument("--variant", choices=("cuda", "llvm"), default="cuda")
    parser.add_argument("--minutes", type=float, default=8.0)
    options = parser.parse_args()
    out = options.out.resolve()
    if options.prepare:
        prepare(out, options.python, options.without)
        return
    if not (out / CAPTURE).is_dir() or not (out / MODEL).is_file():
        parser.error(f"{out} has no capture or model. First: python -m bench.gpu {options.out} --prepare")
    end = time.perf_counter() + 60 * options.minutes
    table = Table("part", "s", "GPU GB", "result", title=device(options.variant), title_justify="left")
    record = []
    for part in parts(out, options.variant):
        part.run(out, end - time.perf_counter())
        table.add_row(part.name, f"{part.seconds:.0f}", f"{part.gpu_gb:.1f}" if part.gpu_gb else "-", part.outcome)
        print(f"{part.name}: {part.seconds:.0f} s, {part.outcome}", flush=True)
        record.append({"part": part.name, "seconds": part.seconds, "gpu_gb": part.gpu_gb, "outcome": part.outcome})
    (out / "gpu.json").write_text(json.dumps({"device": device(options.variant), "parts": record}, indent=2))
    Console(width=120).print(table)


if __name__ == "__main__":
    main()
