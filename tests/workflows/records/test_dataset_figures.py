"""`gnmreg dataset describe`: counts of subjects and samples, and the names of what is not stated."""

import csv
import json
import shutil
from pathlib import Path
from typing import Any

import pytest

from coregister.synthetic.expressions import EXPRESSIONS
from tests.registration.capture import small
from tests.workflows.browser import launch, needs_browser, sideways_px
from workflows.cli.app import main
from workflows.records.dataset import read_dataset
from workflows.records.dataset_figures import CATEGORIES, COLUMNS, csv_text, describe

PEOPLE: dict[str, tuple[dict[str, Any], dict[str, dict[str, Any]]]] = {  # tags; expression -> tags of the capture
    "a": (
        {"gender": "female", "age": 34, "ethnicity": "asian"},
        {"smile": {"category": "flexing"}, "blink": {"category": "eyes"}, "odd": {}},
    ),
    "b": ({"gender": "male", "age": 39.5, "ethnicity": " "}, {"smile": {"category": "flexing"}}),
    "c": ({"gender": "female", "age": 61}, {"dance": {"category": "=1+1"}}),
    "d": ({"ethnicity": "white"}, {}),
}


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("people")
    capture = small.make(root / "source" / "capture", drop=("mask", "normals"))
    folder = root / "people"
    for name, (tags, expressions) in PEOPLE.items():
        for expression, own in {"neutral": {}, **expressions}.items():
            shutil.copytree(capture, folder / name / expression)
            fields = {"subject": name, "expression": expression, "units": "m", **tags, **own}
            lines = [f"{field} = {json.dumps(value)}" for field, value in fields.items()]
            (folder / name / expression / "capture.toml").write_text("\n".join(lines) + "\n")
    shutil.copytree(folder / "d" / "neutral", folder / "d" / "broken")
    (folder / "d" / "broken" / "capture.toml").write_text("subject = ")
    return folder


def counts(dataset: Path, kind: str) -> dict[str, tuple[int, int]]:
    groups = next(each for each in describe(read_dataset(dataset)).distributions if each.kind == kind).groups
    return {each.group: (each.subjects, each.samples) for each in groups if each.samples}


def missing(dataset: Path) -> dict[str, tuple[str, ...]]:
    return {each.kind: each.missing for each in describe(read_dataset(dataset)).distributions}


def test_subjects_and_samples_are_counted_by_tag_and_category(dataset: Path) -> None:
    figures = describe(read_dataset(dataset))
    assert (figures.name, figures.subjects, figures.samples) == ("people", 4, 9)
    assert counts(dataset, "gender") == {"female": (2, 6), "male": (1, 2)}
    assert counts(dataset, "age") == {"30-39": (2, 6), "60-69": (1, 2)}
    assert counts(dataset, "ethnicity") == {"asian": (1, 4), "white": (1, 1)}
    assert counts(dataset, "category") == {"neutral": (4, 4), "flexing": (2, 2), "eyes": (1, 1), "=1+1": (1, 1)}
    assert figures.empty_categories == tuple(name for name in CATEGORIES if name not in ("flexing", "eyes"))
    assert [(each.group, each.subjects) for each in figures.expressions if each.group == "smile"] == [("smile", 2)]


def test_what_is_not_stated_or_cannot_be_read_is_named(dataset: Path) -> None:
    expected = {"gender": ("d",), "age": ("d",), "ethnicity": ("b", "c"), "category": ("a/odd",)}
    assert missing(dataset) == expected
    assert list(describe(read_dataset(dataset)).unreadable) == ["d/broken"]
    rows = list(csv.DictReader(csv_text(describe(read_dataset(dataset))).splitlines()))
    assert tuple(rows[0]) == COLUMNS and (rows[0]["subjects"], rows[0]["samples"]) == ("4", "9")
    named = {row["kind"]: (row["names"], row["samples"]) for row in rows if row["group"] == "not stated"}
    assert named == {"gender": ("d", "1"), "age": ("d", "1"), "ethnicity": ("b; c", "4"), "category": ("a/odd", "1")}
    assert "'=1+1" in {row["group"] for row in rows}  # no spreadsheet computes it
    assert [row["names"] for row in rows if row["kind"] == "unreadable"] == ["d/broken"]


def test_a_record_of_categories_states_those_of_captures_without_the_tag(dataset: Path, tmp_path: Path) -> None:
    copy = shutil.copytree(dataset, tmp_path / "people")
    record = {"kind": "gnm-dataset", "schema": 1, "complete": True}
    categories = {"smile": "lips", "blink": "eyes", "odd": "jaw", "dance": "cheeks"}
    (copy / "dataset.json").write_text(json.dumps({**record, "categories": categories}))
    assert missing(copy)["category"] == ()
    assert counts(copy, "category")["flexing"] == (2, 2) and counts(copy, "category")["jaw"] == (1, 1)


def test_the_ten_categories_are_those_of_synthetic_expressions() -> None:
    assert set(CATEGORIES) == {each.category for each in EXPRESSIONS.values()} - {"neutral"} and len(CATEGORIES) == 10


def test_the_command_prints_and_writes(dataset: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    page = tmp_path / "new" / "people.html"
    assert main(["dataset", "describe", str(dataset), "--out", str(page)]) == 0
    text = capsys.readouterr().out
    assert (
        "4 subjects, 9 samples" in text
        and "gender, subjects (samples): female 2 (6); male 1 (2); not stated: d" in text
    )
    assert "not counted: d/broken" in text
    assert page.with_suffix(".csv").read_text() == csv_text(describe(read_dataset(dataset)))
    html = page.read_text()
    assert "a/odd" in html and "http" not in html.replace("http://www.w3.org", "")
    assert main(["dataset", "describe", str(dataset), "--out", str(tmp_path / "people.txt")]) == 2
    assert main(["dataset", "describe", str(tmp_path / "none")]) == 2
    assert "ends in .html" in (error := capsys.readouterr().err) and "no subjects" in error
    assert sorted(path.name for path in tmp_path.iterdir()) == ["new"]


@needs_browser
def test_the_page_does_not_scroll_sideways(dataset: Path, tmp_path: Path) -> None:
    sync_api = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    assert main(["dataset", "describe", str(dataset), "--out", str(tmp_path / "index.html")]) == 0
    with launch(sync_api) as browser:
        assert sideways_px(browser, tmp_path / "index.html") == {400: 0, 1280: 0}
