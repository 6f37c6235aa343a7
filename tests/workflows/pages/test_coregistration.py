"""The page of a coregistration."""

import re
from pathlib import Path
from typing import Any
from urllib.parse import unquote

from workflows.pages import coregistration
from workflows.pages.coregistration import render_coregistration_page
from workflows.records.round_files import RoundFiles, find_round_files

PLAN = {
    "dataset": "/data/a<b>",
    "options": {"recipe": "draft", "seed": 0},
    "split": {"training": ["s#1", "s 2"], "held_out": ["held"], "how": "&"},
    "captures": {"s#1": ["rest", "smile?"], "s 2": ["rest"], "held": ["rest"]},
    "without_truth": ["held"],
}
EMPTY = {
    "plan": PLAN,
    "sources": {},
    "lost": [],
    "rounds": [],
    "generalization_mm": {},
    "specificity_mm": {},
    "at": 0,
    "verdict": None,
}


def render(record: dict[str, Any], files: tuple[RoundFiles, ...] = ()) -> str:
    return render_coregistration_page(record, files, "NOW")


def a_round(name: str) -> dict[str, Any]:
    row = {"usable": True, "reason": ""}
    return {
        "name": name,
        "register": {"s<1>": {"rest": row, "smile": {"usable": False, "reason": "<off>"}}},
        "stabilize": {"out": "x"},
        "build": {"rejected": [{"name": "q", "reason": "r&r"}], "components": 3, "drift_mm": 0.25},
    }


def write(out: Path, *files: str) -> None:
    for name in files:
        (out / name).parent.mkdir(parents=True, exist_ok=True)
        (out / name).write_text("")


def linked(page: str) -> list[str]:
    return [unquote(link) for link in re.findall(r'href="([^"]*)"', page)]


def test_a_run_without_rounds_has_a_page():
    page = render(EMPTY)
    assert "The first round is not done yet." in page and "As of NOW UTC" in page
    assert "Held-out subjects: 0 of 1 captures have a report. Of round it00 there is nothing yet." in page
    assert "a&lt;b&gt;" in page and "<b>" not in page and "<script" not in page
    assert linked(page) == ["coregistration.json", "plan.json"]


def test_rounds_are_listed_with_their_failures():
    curves = {"model 0": {"5": 1.5}, "model 1": {"5": 1.25}}
    verdict = {"proceed": False, "reason": "no gain"}
    page = render(
        EMPTY | {"rounds": [a_round("it 00")], "generalization_mm": curves, "at": 5, "verdict": verdict, "lost": ["z<"]}
    )
    for text in ("1.500 mm with 5 components", ">1.250</td>", "0.250", "Ended: no gain.", "z&lt;", "<svg"):
        assert text in page, text
    for text in ("s&lt;1&gt;, smile", "&lt;off&gt;", "r&amp;r"):
        assert text in page, text
    assert "–" in page  # no specificity
    assert "nothing yet" not in page


def test_the_running_round_and_everything_that_exists_are_linked(tmp_path: Path):
    names = (
        *("it00/registrations/s#1/index.html", "it00/registrations/s#1/rest/report.html"),
        *("it00/registrations/s 2/index.html", "it00/registrations/stabilized/index.html"),
        *("it00/model/index.html", "it00/model/gnm_head.npz", "it01/registrations/s#1/index.html"),
        "held_out/held_out.npz",
    )
    write(tmp_path, *names, "it00/registrations/s 2/notes.html", "other/index.html")
    page = render(EMPTY, find_round_files(tmp_path, PLAN))
    assert sorted(linked(page)) == sorted((*names, "coregistration.json", "plan.json"))
    assert "it00/registrations/s%231/rest/report.html" in page and "s%202/index.html" in page
    assert "Round it00: 1 of 3 captures have a report;" in page
    assert "done: stabilized expressions, model; not done: evaluation." in page
    assert page.count("left by an earlier run") == 1  # it01: the first round is not done
    assert page.count("<details open>") == 1

    done = EMPTY | {"rounds": [a_round("it00")], "verdict": {"proceed": True, "reason": "gain 9 %"}}
    page = render(done, find_round_files(tmp_path, PLAN))
    assert "Round it01: 0 of 3 captures have a report; done: nothing else;" in page
    assert "left by an earlier run" not in page


def test_a_stopped_run_says_why():
    page = render(EMPTY | {"stopped": "parked: it00: 2 of 8 captures failed"})
    assert "Stopped: parked: it00: 2 of 8 captures failed." in page


def test_very_many_reports_are_linked_by_the_subjects_pages_alone(tmp_path: Path, monkeypatch):
    monkeypatch.setattr(coregistration, "_MAX_REPORTS", 2)
    write(tmp_path, "it00/registrations/s#1/index.html", "it00/registrations/s#1/rest/report.html")
    page = render(EMPTY, find_round_files(tmp_path, PLAN))
    assert "it00/registrations/s#1/index.html" in linked(page)
    assert not any(link.endswith("report.html") for link in linked(page))
    assert "1 of 3 captures with a report" in page
