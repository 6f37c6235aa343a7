"""Measure the opening of the eyelids of registered synthetic people whose eyes are closed, half closed or open.

    python -m bench.lids [--expressions blink half_blink neutral] [--given images normals] [--seed 8]

Each person is rendered (`gnmreg capture synth`) and registered from photographs and cameras alone, or with normals and
masks but neither labels nor landmarks. The opening is the mean distance between three points of the upper and of the
lower lid of the first model, in the truth and in the registration, mm; negative where the upper lid's points lie below
the lower lid's. The truth of `blink` is -2.89 and -3.23: the upper lid covers the edge of the lower one.
"""

import argparse
import shutil
import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float
from rich.console import Console
from rich.table import Table

from bench.photographs import run_command
from coregister.first_model import build
from registration.model import gnm_npz
from registration.model.landmarks import LandmarkScheme, shipped_schemes
from registration.storage.registration_folder import load_registration

# Points of the scheme face478 on the upper and the lower lid, of the subject's side.
LIDS = {"right": ((160, 159, 158), (144, 145, 153)), "left": ((387, 386, 385), (373, 374, 380))}
_CHIN_TO_FOREHEAD = (152, 10)
GIVEN = {"images": (), "normals": ("normals", "masks")}
_ALWAYS = ("capture.toml", "sparse", "images")


def opening_mm(scheme: LandmarkScheme, vertices: Float[np.ndarray, "V 3"], side: str) -> float:
    """Return the mean distance between the points of the upper and the lower lid; negative: they overlap."""
    points = scheme.points(vertices.astype(np.float64))
    upper, lower = (points[list(rows)] for rows in LIDS[side])
    bottom, top = points[list(_CHIN_TO_FOREHEAD)]
    overlap = ((upper - lower) @ (top - bottom)).mean() < 0
    return float(1e3 * np.linalg.norm(upper - lower, axis=1).mean()) * (-1 if overlap else 1)


def measure(whole: Path, given: str, recipe: str, work: Path) -> tuple[str, Sequence[tuple[float, float]]]:
    """Register a capture with some of its channels; status, and truth and result (mm) of both sides."""
    target, out = work / f"{whole.name}_{given}", work / f"{whole.name}_{given}_out"
    target.mkdir()
    for name in (*_ALWAYS, *GIVEN[given]):
        source = whole / name
        (shutil.copytree if source.is_dir() else shutil.copyfile)(source, target / name)
    text = (target / "capture.toml").read_text("utf-8")
    (target / "capture.toml").write_text(text.split("[segmentation]")[0], "utf-8")
    model = build.bootstrap()
    run_command(["register", str(target), "--model", str(model), "--out", str(out), "--recipe", recipe], check=False)
    result = load_registration(out)
    truth = np.load(whole / "ground_truth.npz")["vertices"]
    scheme = shipped_schemes(gnm_npz.read(model))["face478"]
    return result.status, [tuple(opening_mm(scheme, v, side) for v in (truth, result.vertices)) for side in LIDS]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--expressions", nargs="+", default=["blink", "half_blink", "neutral"])
    parser.add_argument("--given", nargs="+", choices=GIVEN, default=list(GIVEN))
    parser.add_argument("--seed", type=int, default=8)
    parser.add_argument("--recipe", default="draft")
    options = parser.parse_args()
    console = Console(width=120)
    table = Table(
        "expression", "given", "status", *(f"{side}: {what}" for side in LIDS for what in ("truth", "result"))
    )
    with tempfile.TemporaryDirectory() as folder:
        for expression in options.expressions:
            whole = Path(folder) / expression
            run_command(["capture", "synth", str(whole), "--seed", str(options.seed), "--expression", expression])
            for given in options.given:
                status, sides = measure(whole, given, options.recipe, Path(folder))
                cells = (expression, given, status, *(f"{value:.2f}" for pair in sides for value in pair))
                console.print(" | ".join(cells))
                table.add_row(*cells)
    console.print(table)


if __name__ == "__main__":
    main()
