"""The quality gate on 200 synthetic registrations, 40 of them spoiled in eight known ways before they are registered.

    python -m bench.gate OUT [--subjects 40] [--labels 50]

Forty people with a neutral and four expressions each, six views of 144 px; the last expression of each is spoiled.
Captures and registrations stay in OUT: a repeated call computes what is missing, `--measure` alone what is there.
Printed are the recall of the spoiled ones (their verdict is not `accept`) and the false alarms among the others: with
the default thresholds, with thresholds from all labels, each registration judged without its own, and with thresholds
from a few random labels, on all other registrations.
"""

import argparse
import csv
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from bench.support.gate_captures import NEUTRAL, WAYS, Sample, expressions_of, make_capture, recipe, samples
from coregister.first_model import build as bootstrap
from registration.errors import InputError
from registration.options import RegisterOptions
from registration.pipeline import register
from registration.storage.registration_folder import is_registration, read_manifest
from workflows.gate.calibrate import Labelled, calibrate
from workflows.gate.figures import assess
from workflows.gate.rules import GateThresholds, judge
from workflows.pages.gate_calibration import render_gate_calibration

DRAWS = 20  # of few labels
REFUSED = "refused"  # file in the place of a registration whose inputs were refused


def compute(out: Path, wanted: Sequence[Sample]) -> None:
    """Register what is missing, and print CPU seconds."""
    model, start = bootstrap.bootstrap(), time.process_time()
    for number, sample in enumerate(sorted(wanted, key=_place), 1):
        target = out / "registrations" / sample.name
        if is_registration(target) or target.with_suffix(f".{REFUSED}").exists():
            continue
        capture = make_capture(sample, out / "captures")
        neutral = None if sample.expression == NEUTRAL else target.parent / NEUTRAL
        try:
            result = register(capture, model, target, RegisterOptions(recipe=recipe(sample)), neutral=neutral)
            status = result.status
        except InputError as error:
            target.parent.mkdir(parents=True, exist_ok=True)
            target.with_suffix(f".{REFUSED}").write_text(error.line)
            status = f"{REFUSED}: {error.line}"
        seconds = time.process_time() - start
        print(f"{number} of {len(wanted)}: {sample.name} {sample.way} {status}; {seconds:.0f} CPU s", flush=True)


def _place(sample: Sample) -> tuple[int, int]:
    """The order: of each person a neutral, a good expression and the spoiled one first, so that a part tells much."""
    first = sample.way or sample.expression in (NEUTRAL, expressions_of(sample.subject)[0])
    return (0 if first else 1, sample.subject)


def read(out: Path, wanted: Sequence[Sample]) -> tuple[list[Sample], list[Labelled], list[Sample]]:
    """Return samples that have a registration, these with their labels, and samples whose inputs were refused."""
    found, labelled, refused = [], [], []
    for sample in wanted:
        target = out / "registrations" / sample.name
        if is_registration(target):
            found.append(sample)
            labelled.append(Labelled(assessed=assess(read_manifest(target)), good=not sample.way))
        elif target.with_suffix(f".{REFUSED}").exists():
            refused.append(sample)
    return found, labelled, refused


def flagged(labelled: Sequence[Labelled], thresholds: GateThresholds) -> np.ndarray:
    """Return which registrations' verdict is not `accept`."""
    return np.array([judge(one.assessed, thresholds).level != "accept" for one in labelled], bool)


def rejected(labelled: Sequence[Labelled], thresholds: GateThresholds) -> np.ndarray:
    """Return which registrations' verdict is `reject`."""
    return np.array([judge(one.assessed, thresholds).level == "reject" for one in labelled], bool)


def crossed(labelled: Sequence[Labelled], folds: int) -> tuple[np.ndarray, np.ndarray]:
    """Return which are flagged, and which rejected, each by thresholds from the labels of other folds."""
    fold = np.arange(len(labelled)) % folds
    flags, gone = np.zeros((2, len(labelled)), bool)
    for number in range(folds):
        rest = [one for one, place in zip(labelled, fold, strict=True) if place != number]
        thresholds = calibrate(rest).thresholds
        tested = np.flatnonzero(fold == number)
        part = [labelled[index] for index in tested.tolist()]
        flags[tested], gone[tested] = flagged(part, thresholds), rejected(part, thresholds)
    return flags, gone


def from_few(labelled: Sequence[Labelled], count: int, seed: int) -> tuple[float, float]:
    """Return recall and false alarms of thresholds from `count` random labels, on all other registrations."""
    chosen = np.random.default_rng(seed).permutation(len(labelled))
    thresholds = calibrate([labelled[index] for index in chosen[:count].tolist()]).thresholds
    tested = [labelled[index] for index in chosen[count:].tolist()]
    flags, good = flagged(tested, thresholds), np.array([one.good for one in tested])
    if good.all():
        raise InputError("No spoiled one is left", where="labels", expected="fewer labels", got=count)
    return float(flags[~good].mean()), float(flags[good].mean())


def measure(out: Path, wanted: Sequence[Sample], labels: int) -> None:
    """Print recall and false alarms, per way of spoiling, and write the labels and the page of the calibration."""
    found, labelled, refused = read(out, wanted)
    good = np.array([one.good for one in labelled])
    print(f"{len(labelled)} registrations, {(~good).sum()} of them spoiled; {len(refused)} refused by register")
    folds = min(len(labelled), 20)
    default = GateThresholds()
    flags, gone = crossed(labelled, folds)
    rows = {
        "default thresholds": (flagged(labelled, default), rejected(labelled, default)),
        f"from all labels, in {folds} parts": (flags, gone),
    }
    print(f"{'':28}" + "".join(f"{name:>34}" for name in rows))
    for way in (*WAYS, ""):
        members = np.array([sample.way == way for sample in found])
        lost = sum(sample.way == way for sample in refused)
        cells = [
            f"{(flag[members].sum() + lost):4} of {members.sum() + lost} ({bad[members].sum()} rejected)"
            for flag, bad in rows.values()
        ]
        print(f"{way or 'good':28}" + "".join(f"{cell:>34}" for cell in cells))
    for name, (flag, _) in rows.items():
        recall = (flag[~good].sum() + sum(bool(s.way) for s in refused)) / max(1, (~good).sum() + len(refused))
        print(f"{name}: recall {recall:.3f}, false alarms {flag[good].mean():.3f}")
    few = []
    for seed in range(DRAWS):
        try:
            few.append(from_few(labelled, labels, seed))
        except InputError:  # too few bad ones among them, or no others
            continue
    if few:
        recall, alarms = np.mean(few, 0)
        low, high = np.min(few, 0)[0], np.max(few, 0)[1]
        print(
            f"from {labels} random labels, {len(few)} of {DRAWS} draws: recall {recall:.3f} (least {low:.3f}), "
            f"false alarms {alarms:.3f} (most {high:.3f})"
        )
    result = calibrate(labelled)
    result.thresholds.write(out / "thresholds.json")
    (out / "thresholds.html").write_text(render_gate_calibration(result.view), encoding="utf-8")
    with (out / "labels.csv").open("w", encoding="utf-8", newline="") as file:
        csv.writer(file).writerows([("name", "label"), *((s.name, "bad" if s.way else "good") for s in found)])
    for sample, flag, one in zip(found, flags, labelled, strict=True):
        if bool(sample.way) != flag:
            verdict = judge(one.assessed, result.thresholds)
            print(f"{'missed' if sample.way else 'false alarm'}: {sample.name} {sample.way}: {verdict.text}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("--subjects", type=int, default=40)
    parser.add_argument("--labels", type=int, default=50, help="labels of the calibration from a few")
    parser.add_argument("--measure", action="store_true", help="compute nothing, measure what is there")
    options = parser.parse_args()
    wanted = samples(options.subjects)
    if not options.measure:
        compute(options.out, wanted)
    measure(options.out, wanted, options.labels)


if __name__ == "__main__":
    main()
