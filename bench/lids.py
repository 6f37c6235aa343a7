"""Measure the opening of the eyelids of registered synthetic people whose eyes are closed, half closed or open.

    python -m bench.lids [--expressions blink half_blink neutral] [--given images normals] [--seeds 8 9] [--keep DIR]

Each person is rendered (`gnmreg capture synth`) and registered from photographs and cameras alone, or with normals and
masks but neither labels nor landmarks. The opening is the mean distance between three points of the upper and of the
lower lid of the first model, in the truth and in the registration, mm; negative where the upper lid's points lie below
the lower lid's, as in `blink`, where the upper lid covers the edge of the lower one by about 3 mm. With --keep,
captures and registrations stay in that folder, and captures that are there already are used.
"""

import argparse
import shutil
import tempfile
from collections.abc import Sequence
from itertools import product
from pathlib import Path

import numpy as np
from jaxtyping import Float
from rich.console import Console
from rich.table import Table

from bench.photographs import run_command
from coregister.first_model import build
from coregister.synthetic.expressions import EXPRESSIONS
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
    for folder in (target, out):
        shutil.rmtree(folder, ignore_errors=True)
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
    names = ["blink", "half_blink", "neutral"]
    parser.add_argument("--expressions", nargs="+", choices=EXPRESSIONS, metavar="NAME", default=names)
    parser.add_argument("--given", nargs="+", choices=GIVEN, default=list(GIVEN))
    parser.add_argument("--seeds", nargs="+", type=int, default=[8])
    parser.add_argument("--recipe", default="draft")
    parser.add_argument("--keep", type=Path, metavar="DIR", help="keep captures and registrations in this folder")
    options = parser.parse_args()
    console = Console(width=120)
    sides = (f"{side}: {what}" for side in LIDS for what in ("truth", "result"))
    table = Table("seed", "expression", "given", "status", *sides)
    with tempfile.TemporaryDirectory() as temporary:
        folder = options.keep or Path(temporary)
        for seed, expression, given in product(options.seeds, options.expressions, options.given):
            whole = folder / f"{expression}_{seed}"
            if not whole.exists():
                run_command(["capture", "synth", str(whole), "--seed", str(seed), "--expression", expression])
            status, openings = measure(whole, given, options.recipe, folder)
            cells = (str(seed), expression, given, status, *(f"{value:.2f}" for pair in openings for value in pair))
            console.print(" | ".join(cells))
            table.add_row(*cells)
    console.print(table)


if __name__ == "__main__":
    main()
