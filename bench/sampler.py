"""Measure the semantic sampler.

    python -m bench.sampler [--only factors collapse population keras] [--out DIR]

factors: samples with eight known factors within 20 classes. collapse: the same with a deliberately heavy KL weight.
population: 12,000 synthetic people of the first model, with tags by construction. keras: the decoders released with GNM
against Keras in an environment of its own (--keras its python; without it the section is left out). The exit status is
1 if a limit is not kept. Figures are written to DIR as they are found, SECTION.json.
"""

import argparse
import importlib
import sys
from dataclasses import asdict
from pathlib import Path

import torch
from rich.console import Console
from rich.table import Table

from bench.sampler_checks import BenchOptions
from registration.storage.files import write_json

SECTIONS = {"factors": "factors", "collapse": "collapse", "population": "people", "keras": "decoders"}  # -> module
GNM = Path(__file__).resolve().parent.parent.parent / "shared" / "data" / "gnm"


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="+", choices=SECTIONS, default=tuple(SECTIONS))
    parser.add_argument("--count", type=int, default=12_000, help="samples of factors, collapse and population")
    parser.add_argument("--steps", type=int, default=8_000, help="of each training")
    parser.add_argument(
        "--audited", type=int, default=200, help="heads that are audited of each kind: drawn ones, and held-out samples"
    )
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--keras", type=Path, help="python of an environment with keras and a backend")
    parser.add_argument("--decoders", type=Path, default=GNM, help="folder of the released decoders")
    parser.add_argument(
        "--out",
        type=Path,
        help="folder for the figures of each section, the population, its sampler and a contact sheet",
    )
    options = BenchOptions(**{name: value for name, value in vars(parser.parse_args()).items()})
    table = Table("section", "figure", "value", "limit", "")
    console, kept = Console(width=150), True
    if options.out:
        options.out.mkdir(parents=True, exist_ok=True)
    for section in options.only:
        found = list[dict[str, object]]()
        for figure in importlib.import_module(f"bench.sampler_checks.{SECTIONS[section]}").figures(options):
            console.print(f"{section}: {figure.name}: {figure.value}")
            table.add_row(section, figure.name, figure.value, figure.limit, "" if figure.kept else "NOT KEPT")
            kept &= figure.kept
            found.append(asdict(figure))
            if options.out:
                write_json(options.out / f"{section}.json", found)
    console.print(table)
    console.print(f"torch used {torch.get_num_threads()} threads")
    return 0 if kept else 1


if __name__ == "__main__":
    sys.exit(main())
