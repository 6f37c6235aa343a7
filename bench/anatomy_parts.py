"""Measure regenerated eyes, teeth, tongue and pupils of models.

    python -m bench.anatomy_parts [--model NPZ ...] [--only eyes ...] [--out FOLDER]

Without --model: the first model, and the reconstructed GNM file of a folder `shared` beside the repository, if there is
one. --out keeps what subject_teeth makes, in a folder per model, so that its next run fits only what has changed.
Each section is a module of bench/anatomy_checks; the exit status is 1 if a limit is not kept.
"""

import argparse
import importlib
import pkgutil
import sys
from functools import partial
from pathlib import Path

from rich.console import Console
from rich.table import Table

from bench import anatomy_checks
from coregister.first_model import build
from registration.model import gnm_npz

SHARED = Path(__file__).resolve().parent.parent.parent / "shared" / "data"
SECTIONS = tuple(module.name for module in pkgutil.iter_modules(anatomy_checks.__path__))


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--model", type=Path, nargs="+")
    parser.add_argument("--only", nargs="+", choices=SECTIONS, default=SECTIONS)
    parser.add_argument("--out", type=Path, help="keep the captures and registrations of subject_teeth here")
    options = parser.parse_args()
    known = (SHARED / "gnm" / "gnm_head_reconstructed.npz",)
    models = options.model or [build.bootstrap(), *filter(Path.is_file, known)]
    table = Table("model", "section", "figure", "value", "limit", "")
    console, kept = Console(width=150), True
    for path in models:
        data = gnm_npz.read(path)
        for section in options.only:
            figures = importlib.import_module(f"bench.anatomy_checks.{section}").figures
            if options.out and section == "subject_teeth":
                figures = partial(figures, out=options.out / path.stem)
            for figure in figures(data):
                cells = (path.stem, section, figure.name, f"{figure.value:.4g} {figure.unit}", figure.limit)
                table.add_row(*cells, "" if figure.kept else "NOT KEPT")
                kept &= figure.kept
    console.print(table)
    return 0 if kept else 1


if __name__ == "__main__":
    sys.exit(main())
