"""Calibration of the gate from labels, on figures of known distributions."""

import csv
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from registration.errors import InputError
from tests.workflows.gate import made
from workflows.cli.app import main
from workflows.gate.calibrate import Labelled, calibrate, labelled, read_labels, roc
from workflows.gate.figures import Assessed, GateFigures
from workflows.gate.items import find_registrations, gate_items
from workflows.gate.rules import GateThresholds, judge


def examples(good: int, bad: int, seed: int = 0, distance: float = 20.0) -> list[Labelled]:
    """Return figures of a gamma distribution; of each bad one, one figure is `distance` times as large."""
    rng = np.random.default_rng(seed)
    names = ("landmarks_px", "silhouette_px", "normals_deg", "labels_percent", "neutral_texture")
    found = []
    for number in range(good + bad):
        values = dict(zip(names, rng.gamma(9, 0.2, len(names)) * (1, 1, 1, 1, 0.05), strict=True))
        if number >= good:
            values[names[number % len(names)]] *= distance
        figures = GateFigures(**values)
        assessed = Assessed(content_id=str(number), status="converged", reason="", is_neutral=False, figures=figures)
        found.append(Labelled(assessed=assessed, good=number < good))
    return found


def rates(thresholds: GateThresholds, tested: list[Labelled]) -> tuple[float, float]:
    flagged = [judge(example.assessed, thresholds).level != "accept" for example in tested]
    bad = [flag for flag, example in zip(flagged, tested, strict=True) if not example.good]
    good = [flag for flag, example in zip(flagged, tested, strict=True) if example.good]
    return float(np.mean(bad)), float(np.mean(good))


def test_fifty_labels_find_limits_that_hold_for_others():
    result = calibrate(examples(40, 10))
    recall, alarms = rates(result.thresholds, examples(400, 100, seed=1))
    assert recall == 1.0 and alarms <= 0.1
    found = result.thresholds.calibration
    assert found is not None and (found.good, found.bad) == (40, 10)
    assert found.recall == 1.0 and found.false_alarms <= 0.15  # told without looking at each one's own label


def test_labels_that_mean_nothing_are_told_as_such():
    result = calibrate(examples(40, 10, distance=1.0))
    found = result.thresholds.calibration
    assert found is not None and found.recall <= 0.4 and 0.3 < result.view.combined.area < 0.7


def test_limits_are_monotone_and_rejection_lies_beyond_a_look():
    limits = calibrate(examples(40, 10)).thresholds.limits
    for name in ("landmarks_px", "silhouette_px", "normals_deg", "labels_percent"):
        assert 1.8 < limits[name].look < limits[name].reject
    assert limits["neutral_texture"].reject is None  # the defaults never reject by it
    assert limits["scan_mm"] == GateThresholds().scan_mm  # no label has this figure


def test_a_single_wild_good_one_does_not_move_the_limits():
    tested = examples(40, 10)
    wild = replace(tested[0], assessed=replace(tested[0].assessed, figures=GateFigures(normals_deg=500.0)))
    before, after = (calibrate(ones).thresholds.normals_deg.look for ones in (tested, [wild, *tested[1:]]))
    assert before is not None and after is not None and after < 2 * before


def test_good_ones_that_were_stopped_ask_for_no_look():
    tested = examples(40, 10)
    stopped = [replace(e, assessed=replace(e.assessed, status="stopped")) for e in tested[:10]] + tested[10:]
    assert calibrate(tested).thresholds.stopped == "look"
    assert calibrate(stopped).thresholds.stopped == "accept"


@pytest.mark.parametrize(("good", "bad"), [(40, 4), (14, 20), (0, 30), (50, 0)])
def test_too_few_labels_or_one_class_are_refused(good, bad):
    with pytest.raises(InputError, match="too few labels") as error:
        calibrate(examples(good, bad))
    assert f"{good} good, {bad} bad" in error.value.got


def test_failed_registrations_are_no_evidence():
    tested = examples(40, 10)
    failed = [replace(e, assessed=replace(e.assessed, status="failed")) if not e.good else e for e in tested]
    with pytest.raises(InputError, match="too few labels"):
        calibrate(failed)


def test_the_area_below_known_curves():
    good = np.array([True] * 4 + [False] * 4)
    assert roc(np.array([0.0, 1, 2, 3, 4, 5, 6, 7]), good, "").area == 1.0
    assert roc(np.zeros(8), good, "").area == 0.5
    assert roc(np.array([0, 2, 4, 6, 1, 3, 5, 7.0]), good, "").area == pytest.approx(10 / 16)
    unknown = roc(np.array([0.0, 1, 2, 3, -np.inf, -np.inf, 6, 7]), good, "")
    assert unknown.area == pytest.approx(0.5) and unknown.recall[-1] == 1.0


@pytest.mark.parametrize(
    ("text", "got"),
    [
        ("", "nothing"),
        ("name,verdict\na,good\n", "name, verdict"),
        ("name,label\na,fine\n", "a, fine"),
        ("name,label\na,good\na,bad\n", "line 3: a again"),
        ("name,label\n,good\n", "good"),
    ],
)
def test_tables_of_labels_that_cannot_be_read(tmp_path: Path, text: str, got: str):
    (tmp_path / "labels.csv").write_text(text)
    with pytest.raises(InputError, match="table of labels") as error:
        read_labels(tmp_path / "labels.csv")
    assert got in error.value.got


def test_labels_of_other_registrations_are_refused(tmp_path):
    made.write_subject(tmp_path / "run" / "ann", 1, {"neutral": made.figures()})
    items = gate_items(find_registrations(str(tmp_path / "run")), GateThresholds(), {})
    content_id = items[0].content_id
    assert [e.good for e in labelled(items, {content_id: False}, "labels.csv")] == [False]
    with pytest.raises(InputError, match="not in the run") as error:
        labelled(items, {"ann/neutral": True, "bob/neutral": True}, "labels.csv")
    assert error.value.got == "bob/neutral"


def test_the_command_writes_thresholds_that_the_next_uses_and_a_page(tmp_path, capsys):
    rng = np.random.default_rng(0)
    captures = {}
    for number in range(24):
        factor = 1.0 if number < 18 else 8.0
        normals = factor * float(rng.uniform(2.0, 3.0))
        captures[f"c{number:02d}"] = made.figures(normals_deg=normals)
    run, labels, out = tmp_path / "run", tmp_path / "labels.csv", tmp_path / "thresholds.json"
    made.write_subject(run / "ann", 1, captures)
    with labels.open("w") as file:
        rows = [(f"ann/{name}", "good" if number < 18 else "bad") for number, name in enumerate(captures)]
        csv.writer(file).writerows([("name", "label"), *rows])
    command = ["gate", "calibrate", str(run), "--labels", str(labels), "--out", str(out)]
    assert main(command) == 0
    shown = capsys.readouterr().out
    assert "100 % of 6 bad ones" in shown and str(out) in shown
    page = out.with_suffix(".html").read_text()
    assert "24 labels" in page and "normals" in page and not re.search(r"""(src|href)=["']?http""", page)
    assert main(["gate", "verdicts", str(run), "--thresholds", str(out)]) == 0
    listed = capsys.readouterr().out.splitlines()
    assert [line.split()[1] == "accept" for line in listed[:24]] == [True] * 18 + [False] * 6
    labels.write_text("name,label\nann/c00,good\n")
    assert main(command) == 2 and "too few labels" in capsys.readouterr().err
