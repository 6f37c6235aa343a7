"""Measure the fit of models to landmarks: exactness, calibration, noise, single views, a talking head, the mouth.

    python -m bench.landmark_fit [--gnm GNM.npz] [--only NAME ...] [--count N] [--processes 2] [--out FOLDER]

Two models are fitted: the first model, and the file of `--gnm` if one is given. Experiments, with their numbers of
heads unless `--count` states another:

exact      noiseless landmarks in three views: 5 heads
coverage   90 % intervals under one pixel of noise: 40 heads
schur      steps of the eliminated and of the dense system: 6 frames
frames     identity of one frame and of ten: 10 heads
noise      600 landmarks with one pixel of noise, in one, three and eight views: 20 heads
sequence   a talking head in one view: 300 frames
single     the paper's single-view experiment: 2,000 pictures of people of each model, 300 of other people
oral       teeth and tongue of open mouths: 40 heads
mediapipe  MediaPipe's own points of rendered faces beside ours: 12 faces

Tables are printed with the limits asked for. `--out` gets the pictures of `mediapipe`.
"""

import argparse
from pathlib import Path

from rich.console import Console

from bench.landmark_fits import mediapipe, noise, oral, sequence, single, solver_checks
from bench.landmark_fits.heads import HeadModel
from bench.landmark_fits.people import OfMakeHuman, OfModel
from bench.landmark_fits.rows import Row, show

COUNTS = {
    **{"exact": 5, "coverage": 40, "schur": 6, "frames": 10, "noise": 20, "sequence": 300, "single": 2000},
    **{"oral": 40, "mediapipe": 12},
}
_OF_EACH_MODEL = {
    "exact": solver_checks.exact,
    "coverage": solver_checks.coverage,
    "schur": solver_checks.schur,
    "frames": solver_checks.frames,
    "noise": noise.noise,
    "sequence": sequence.sequence,
}


def run(name: str, models: list[HeadModel], count: int, processes: int, out: Path | None) -> list[Row]:
    """Run and print one experiment."""
    notes: list[str] = []
    if name == "single":
        rows, notes = single.single(_cases(models), count, processes)
    elif name == "oral":
        rows = oral.oral(models[0], count)
    elif name == "mediapipe":
        rows, notes = mediapipe.mediapipe(models, count, out)
    else:
        rows = [row for model in models for row in _OF_EACH_MODEL[name](model, count)]
    show(name, rows, notes)
    return rows


def _cases(models: list[HeadModel]) -> list[single.Case]:
    """In-model people of each model, MakeHuman's people, and the other topology's people."""
    first = models[0]
    makehuman = OfMakeHuman(first)
    cases = [single.Case(people=OfModel(model), model=model, in_model=True) for model in reversed(models)]
    cases += [single.Case(people=makehuman, model=model) for model in models]
    return cases + [single.Case(people=OfModel(model), model=first) for model in models[1:]]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--gnm", type=Path, help="a second model: a GNM NPZ file")
    parser.add_argument("--only", nargs="+", choices=COUNTS, default=list(COUNTS), metavar="NAME")
    parser.add_argument("--count", type=int, help="heads, frames or pictures of each experiment")
    parser.add_argument("--processes", type=int, default=2, help="of the experiment `single`")
    parser.add_argument("--out", type=Path, help="folder for pictures")
    options = parser.parse_args()
    models = [HeadModel.read("first model", None)]
    if options.gnm:
        models.append(HeadModel.read("GNM file", options.gnm))
    rows = []
    for name in options.only:
        rows += run(name, models, options.count or COUNTS[name], options.processes, options.out)
    asked = [row for row in rows if row.ok is not None]
    Console().print(f"{sum(bool(row.ok) for row in asked)} of {len(asked)} limits kept")


if __name__ == "__main__":
    main()
