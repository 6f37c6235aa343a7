"""Thresholds proposed from labelled registrations (docs/gate.md).

Every rule stays monotone: a limit lies `spreads` robust spreads above the median of the good ones' figures. This number
is the same for all rules, so that few labels determine it: it is the only thing that the bad ones are used for.
"""

import csv
import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from registration.errors import InputError
from registration.storage.reading import read_text
from workflows.gate.figures import FIGURES, Assessed
from workflows.gate.item import GateItem
from workflows.gate.rules import Calibration, GateThresholds, Limit, judge
from workflows.pages.gate_calibration import CalibrationView, RocCurve

MIN_GOOD, MIN_BAD = 15, 5  # labels
MIN_JUDGED = 3  # bad ones that did not fail: failed ones are rejected whatever the limits are
MAX_FALSE_ALARMS = 0.1  # share of the good ones, at which recall is traded for no more
_FOLDS = 50  # of the check of the whole calibration, at most
_MARGIN = 1.25  # of the limit beyond the last score below it
_REJECT_RATIO = 2.0  # of the limits of rejection and of a look, in spreads
_MAX_STOPPED = 0.05  # share of the good ones that were stopped, above which that asks for no look
_FIX = "label more of them: choose at random, and let both labels occur"


@dataclass(frozen=True, kw_only=True)
class Labelled:
    """A registration and a person's label."""

    assessed: Assessed
    good: bool


@dataclass(frozen=True, kw_only=True)
class CalibrationResult:
    """Proposed thresholds, and the curves by which a person judges them."""

    thresholds: GateThresholds
    view: CalibrationView


def read_labels(file: Path) -> dict[str, bool]:
    """Read a CSV file of labels: columns `name` and `label`; a name is a registration's or its content id.

    Returns:
        Name -> whether it is good.

    Raises:
        InputError: the file cannot be read, lacks a column, holds another label than good or bad, or a name twice.
    """
    refuse = partial(
        InputError.unreadable,
        "table of labels",
        where=file,
        fix="write a line `name,label`, then NAME,good or NAME,bad",
    )
    rows = list(csv.reader(io.StringIO(read_text(Path(file), refuse))))
    head = [cell.strip() for cell in rows[0]] if rows else []
    if not {"name", "label"} <= set(head):
        raise refuse(expected="the columns name and label", got=", ".join(head) or "nothing")
    labels: dict[str, bool] = {}
    for number, row in enumerate(rows[1:], 2):
        if not any(cell.strip() for cell in row):
            continue
        cells = dict(zip(head, (cell.strip() for cell in row), strict=False))
        name, label = cells.get("name", ""), cells.get("label", "")
        if label not in ("good", "bad") or not name:
            raise refuse(expected=f"line {number}: a name, and good or bad", got=", ".join(row))
        if name in labels:
            raise refuse(expected="each name once", got=f"line {number}: {name} again")
        labels[name] = label == "good"
    return labels


def labelled(items: Sequence[GateItem], labels: Mapping[str, bool], where: object) -> list[Labelled]:
    """Return the labelled registrations of a run.

    Raises:
        InputError: a label's registration is not among the items. `where` names the labels.
    """
    by_name = {item.content_id: item for item in items} | {item.name: item for item in items}
    missing = [name for name in labels if name not in by_name]
    if missing:
        raise InputError(
            "Labels name registrations that are not in the run",
            where=where,
            expected="names as `gnmreg gate verdicts` prints them",
            got=f"{missing[0]}" + (f", and {len(missing) - 1} more" if len(missing) > 1 else ""),
            fix="correct the names, or name all the runs",
        )
    return [Labelled(assessed=by_name[name].assessed, good=good) for name, good in labels.items()]


def calibrate(examples: Sequence[Labelled], base: GateThresholds | None = None) -> CalibrationResult:
    """Propose thresholds from labelled registrations.

    Args:
        examples: a random subset of the registrations that will be judged.
        base: sample share, seed and name; None: the defaults.

    Raises:
        InputError: fewer than `MIN_GOOD` good or `MIN_BAD` bad ones, or fewer than `MIN_JUDGED` bad ones that did not
            fail.
    """
    base = base or GateThresholds(name="calibrated")
    usable = [example for example in examples if example.assessed.status != "failed"]
    good = np.array([example.good for example in usable], bool)
    bad = sum(not example.good for example in examples)
    if good.sum() < MIN_GOOD or bad < MIN_BAD or (~good).sum() < MIN_JUDGED:
        raise InputError(
            "There are too few labels",
            where="labels",
            expected=f"at least {MIN_GOOD} good ones, {MIN_BAD} bad ones, {MIN_JUDGED} of which did not fail",
            got=f"{good.sum()} good, {bad} bad, {(~good).sum()} of which did not fail",
            fix=_FIX,
        )
    values = _values(usable)
    left_out = _left_out_scores(values, good)
    spreads, _ = _operating_point(left_out, good)
    thresholds = _thresholds(values, good, spreads, left_out, usable, base)
    recall, false_alarms = _cross_checked(usable, values, good, base)
    found = Calibration(
        good=int(good.sum()), bad=int((~good).sum()), spreads=spreads, recall=recall, false_alarms=false_alarms
    )
    thresholds = replace(thresholds, calibration=found)
    return CalibrationResult(thresholds=thresholds, view=_view(thresholds, found, values, good, left_out))


def _values(examples: Sequence[Labelled]) -> Float[np.ndarray, "N R"]:
    """The figures of all registrations, NaN where there is none."""
    rows = [example.assessed.figures.known() for example in examples]
    return np.array([[row.get(name, np.nan) for name in FIGURES] for row in rows])


@dataclass(frozen=True, kw_only=True)
class _Usual:
    """What good registrations have: the median and a robust spread of each figure; NaN for one that none has."""

    median: Float[np.ndarray, "R"]
    spread: Float[np.ndarray, "R"]

    def scores(self, values: Float[np.ndarray, "N R"]) -> Float[np.ndarray, "N"]:
        """The largest of a registration's figures, in spreads above the median; 0 if it has none."""
        scaled = (values - self.median) / self.spread
        return np.where(np.isfinite(scaled), scaled, 0.0).max(1, initial=0.0)


def _usual(good_values: Float[np.ndarray, "N R"]) -> _Usual:
    """The larger of two robust estimates, since many figures have a long tail to the side that counts."""
    noise = np.array([kind.noise for kind in FIGURES.values()])
    known = np.isfinite(good_values).any(0)
    filled = np.where(known, good_values, 0.0)
    median = np.nanmedian(filled, 0)
    around = 1.4826 * np.nanmedian(np.abs(filled - median), 0)
    above = (np.nanquantile(filled, 0.9, axis=0) - median) / 1.2816
    spread = np.maximum(np.maximum(around, above), noise)
    return _Usual(median=np.where(known, median, np.nan), spread=spread)


def _left_out_scores(values: Float[np.ndarray, "N R"], good: Bool[np.ndarray, "N"]) -> Float[np.ndarray, "N"]:
    """The score of each registration by what the *other* good ones have."""
    everyone, scores = _usual(values[good]), np.empty(len(values))
    for number, is_good in enumerate(good):
        others = good.copy()
        others[number] = False
        usual = _usual(values[others]) if is_good else everyone
        scores[number] = usual.scores(values[[number]])[0]
    return scores


def _operating_point(scores: Float[np.ndarray, "N"], good: Bool[np.ndarray, "N"]) -> tuple[float, float]:
    """The limit, in spreads, with the best recall minus false alarms, of at most `MAX_FALSE_ALARMS`, and this value.

    Of equal ones the lowest: it lies a little above a score, as labelled faults may be much larger than others to come.
    """
    ordered = np.maximum(np.unique(scores), 0.5)
    limits = np.minimum(_MARGIN * ordered, np.append(np.sqrt(ordered[:-1] * ordered[1:]), np.inf))
    alarms = (scores[good][:, None] > limits).mean(0)
    recall = (scores[~good][:, None] > limits).mean(0)
    gain = np.where(alarms <= MAX_FALSE_ALARMS, recall - alarms, -1.0)
    best = np.flatnonzero(gain >= gain.max() - 1e-12)
    return float(limits[best[0]]), float(gain.max())


def _thresholds(
    values: Float[np.ndarray, "N R"],
    good: Bool[np.ndarray, "N"],
    spreads: float,
    left_out: Float[np.ndarray, "N"],
    examples: Sequence[Labelled],
    base: GateThresholds,
) -> GateThresholds:
    usual, defaults = _usual(values[good]), GateThresholds()
    reject = max(_REJECT_RATIO * spreads, 1.5 * float(left_out[good].max()))
    limits: dict[str, Any] = {}
    for number, name in enumerate(FIGURES):
        default: Limit = getattr(defaults, name)
        if np.isnan(usual.median[number]):
            limits[name] = default  # no good one has it: nothing is known
            continue
        look, gone = (float(usual.median[number] + k * usual.spread[number]) for k in (spreads, reject))
        limits[name] = Limit(look=look, reject=None if default.reject is None else gone)
    stopped = np.mean([e.assessed.status == "stopped" for e in examples if e.good])
    return replace(base, **limits, stopped="accept" if stopped > _MAX_STOPPED else "look", calibration=None)


def _cross_checked(
    examples: Sequence[Labelled], values: Float[np.ndarray, "N R"], good: Bool[np.ndarray, "N"], base: GateThresholds
) -> tuple[float, float]:
    """Recall and false alarms of verdicts, each by thresholds that were calibrated without the registration's label."""
    count = min(len(examples), _FOLDS)
    fold = np.arange(len(examples)) % count
    flagged = np.zeros(len(examples), bool)
    for number in range(count):
        rest = fold != number
        left_out = _left_out_scores(values[rest], good[rest])
        spreads, _ = _operating_point(left_out, good[rest])
        others = [example for example, kept in zip(examples, rest, strict=True) if kept]
        thresholds = _thresholds(values[rest], good[rest], spreads, left_out, others, base)
        for index in np.flatnonzero(~rest).tolist():
            flagged[index] = judge(examples[index].assessed, thresholds).level != "accept"
    return float(flagged[~good].mean()), float(flagged[good].mean())


def _view(
    thresholds: GateThresholds,
    found: Calibration,
    values: Float[np.ndarray, "N R"],
    good: Bool[np.ndarray, "N"],
    left_out: Float[np.ndarray, "N"],
) -> CalibrationView:
    usual = _usual(values[good])
    curves = []
    for number, (name, kind) in enumerate(FIGURES.items()):
        column = values[:, number]
        known = np.isfinite(column)
        limit = getattr(thresholds, name).look
        if known[good].sum() and known[~good].sum():
            # A registration without the figure is never caught by its rule.
            curve = roc(np.where(known, column, -np.inf), good, kind.title)
            caught = int((column[~good & known] > limit).sum()) if limit is not None else 0
            alarms = int((column[good & known] > limit).sum()) if limit is not None else 0
            text = "none" if limit is None else kind.text(limit)
            median = kind.text(float(usual.median[number]))
            curves.append(replace(curve, limit=text, usual=median, caught=caught, alarms=alarms))
    return CalibrationView(
        thresholds_id=thresholds.content_id,
        good=found.good,
        bad=found.bad,
        spreads=found.spreads,
        recall=found.recall,
        false_alarms=found.false_alarms,
        combined=roc(left_out, good, "all rules, each without its own label"),
        rules=tuple(curves),
    )


def roc(scores: Float[np.ndarray, "N"], good: Bool[np.ndarray, "N"], name: str) -> RocCurve:
    """Return the curve of recall against false alarms over all limits of a score, and the area below it."""
    limits = np.append(np.unique(scores[np.isfinite(scores)])[::-1], -np.inf)
    alarms = [0.0, *((scores[good][:, None] >= limits).mean(0)).tolist()]
    recall = [0.0, *((scores[~good][:, None] >= limits).mean(0)).tolist()]
    area = float(np.trapezoid(recall, alarms))
    return RocCurve(name=name, false_alarms=tuple(alarms), recall=tuple(recall), area=area)
