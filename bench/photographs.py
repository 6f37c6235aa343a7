"""Register captures with fewer and fewer channels, down to photographs and cameras alone.

    python -m bench.photographs --model MODEL.npz CAPTURE... [--given images masks scan everything] [--recipe draft]

A capture is a folder; FOLDER:PRESET is a copy with the errors of a preset of `gnmreg capture degrade`; `synth` is a
synthetic person with hair and a shirt. An expression is registered from the neutral of its subject, if that comes
before it among the captures, with the same channels given. `no_stereo` and `no_detection` (with masks) leave steps out.
Distances are those of `gnmreg evaluate` on the face, in mm;
seconds are those of the whole command. A row is printed when it is measured.
"""

import argparse
import json
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from registration.capture.native import read_capture
from registration.degrading.degradation import PRESETS
from registration.degrading.degrade import degrade
from registration.evaluate.evaluation import evaluate_registration
from registration.storage.registration_folder import load_registration


@dataclass(frozen=True, kw_only=True)
class Given:
    """What a registration is given besides images and cameras."""

    kept: frozenset[str]  # files and folders of the capture
    arguments: tuple[str, ...] = ()


GIVEN: Mapping[str, Given] = {
    "images": Given(kept=frozenset()),
    "masks": Given(kept=frozenset({"masks"})),
    "scan": Given(kept=frozenset({"masks", "scan"})),
    "everything": Given(
        kept=frozenset({"masks", "scan", "normals", "segmentation", "landmarks", "depth", "confidence"})
    ),
    "no_stereo": Given(kept=frozenset(), arguments=("--no-stereo",)),
    "no_detection": Given(kept=frozenset({"masks"}), arguments=("--no-detect",)),
}
_ALWAYS = frozenset({"capture.toml", "sparse", "images"})
HEADS = ("capture", "given", "status", "s", "mean", "median", "p95", "vertex error", "drift")


@dataclass(frozen=True, kw_only=True)
class Case:
    """One capture of the table."""

    name: str
    folder: Path
    subject: str
    neutral: bool


def cases(words: list[str], work: Path) -> Iterator[Case]:
    """Return the captures that are named, made where they are not folders."""
    for word in words:
        if word == "synth":
            folder = work / "synth"
            run_command(["capture", "synth", str(folder), "--seed", "8", "--hair", "--shirt"])
            name = "synthetic, hair and shirt"
        else:
            path, _, preset = word.partition(":")
            folder, name = Path(path), "/".join(Path(path).resolve().parts[-2:])
            if preset:
                folder, name = work / f"{name.replace('/', '_')}_{preset}", f"{name}, {preset} errors"
                degrade(Path(path), folder, preset=PRESETS[preset])
        capture = read_capture(folder)
        neutral = capture.expression == "neutral"
        yield Case(name=name, folder=folder, subject=name if ":" in word else capture.subject, neutral=neutral)


def reduced(source: Path, target: Path, given: str) -> Path:
    """Copy a capture with only these channels."""
    kept = _ALWAYS | GIVEN[given].kept
    ignored = [path.name for path in source.iterdir() if path.name not in kept and path.stem not in kept]
    shutil.copytree(source, target, ignore=lambda folder, names: ignored if Path(folder) == source else [])
    if "segmentation" not in kept:
        text = (target / "capture.toml").read_text("utf-8")
        (target / "capture.toml").write_text(text.split("[segmentation]")[0], "utf-8")
    return target


def measure(
    case: Case, given: str, neutral: tuple[Path, Path] | None, work: Path, options: argparse.Namespace
) -> tuple[tuple[str, ...], Path]:
    """Register a case; cells of the table after its name, and the registration's folder."""
    name = f"{case.name} {given}".replace("/", "_").replace(" ", "_").replace(",", "")
    target, out = reduced(case.folder, work / "captures" / name, given), work / "registrations" / name
    arguments = ["register", str(target), "--model", str(options.model), "--out", str(out), "--recipe", options.recipe]
    arguments += GIVEN[given].arguments
    arguments += [] if neutral is None else ["--neutral", str(neutral[0])]
    start = time.perf_counter()
    ran = run_command(arguments, check=False)
    seconds = time.perf_counter() - start
    if not (out / "manifest.json").is_file():
        return ("refused", f"{seconds:.0f}", ran.stderr.strip().splitlines()[-1]), out
    status = json.loads((out / "manifest.json").read_text("utf-8"))["status"]
    registration, against = load_registration(out), {}
    if neutral is not None:
        against = {"neutral": load_registration(neutral[0]), "neutral_capture": read_capture(neutral[1])}
    metrics = evaluate_registration(registration, read_capture(case.folder), **against).metrics
    face = [_figure(metrics, "scan_to_mesh", key) for key in ("mean_mm", "median_mm", "p95_mm")]
    others = [_figure(metrics, name, "mean_mm") for name in ("vertex_error", "drift")]
    return (status, f"{seconds:.0f}", *face, *others), out


def _figure(metrics: Mapping[str, Any], name: str, key: str) -> str:
    value = metrics.get(name, {}).get("face", {}).get(key)
    return "-" if value is None else f"{value:.3f}"


def run_command(arguments: list[str], *, check: bool = True) -> subprocess.CompletedProcess[str]:
    """Run `gnmreg` with these arguments."""
    command = [sys.executable, "-m", "workflows.cli", *arguments]
    return subprocess.run(command, capture_output=True, text=True, check=check)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("captures", nargs="+", metavar="CAPTURE")
    parser.add_argument("--model", required=True, type=Path, metavar="NPZ")
    parser.add_argument("--recipe", default="draft")
    parser.add_argument("--given", nargs="+", choices=GIVEN, default=list(GIVEN)[:4])
    parser.add_argument("--keep", type=Path, metavar="DIR", help="keep captures and registrations in this folder")
    options = parser.parse_args()
    console = Console(width=150)
    table = Table(*HEADS, title=f"{options.recipe}; scan to mesh on the face, vertex error and drift, mm")
    with tempfile.TemporaryDirectory() as folder:
        work = Path(folder) if options.keep is None else options.keep
        work.mkdir(parents=True, exist_ok=True)
        neutrals: dict[tuple[str, str], tuple[Path, Path]] = {}
        for case in cases(options.captures, work):
            for given in options.given:
                key = (case.subject, given)
                cells, out = measure(case, given, None if case.neutral else neutrals.get(key), work, options)
                if case.neutral:
                    neutrals[key] = (out, case.folder)
                console.print(" | ".join((case.name, given, *cells)))
                table.add_row(case.name, given, *cells)
    console.print(table)


if __name__ == "__main__":
    main()
