"""The page of a coregistration."""

import re
from typing import Any

from workflows.pages.coregistration import render_coregistration_page

PLAN = {
    "dataset": "/data/a<b>",
    "options": {"recipe": "draft", "seed": 0},
    "split": {"training": ["x"], "held_out": [], "how": "&"},
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


def a_round(name: str) -> dict[str, Any]:
    row = {"usable": True, "reason": ""}
    return {
        "name": name,
        "register": {"s<1>": {"rest": row, "smile": {"usable": False, "reason": "<off>"}}},
        "stabilize": {"out": "x"},
        "build": {"rejected": [{"name": "q", "reason": "r&r"}], "components": 3, "drift_mm": 0.25},
    }


def test_a_run_without_rounds_has_a_page():
    page = render_coregistration_page(EMPTY)
    assert "The first round is not done yet." in page
    assert "a&lt;b&gt;" in page and "<b>" not in page and "<script" not in page


def test_rounds_link_to_their_results_and_failures_are_listed():
    curves = {"model 0": {"5": 1.5}, "model 1": {"5": 1.25}}
    verdict = {"proceed": False, "reason": "no gain"}
    page = render_coregistration_page(
        EMPTY | {"rounds": [a_round("it 00")], "generalization_mm": curves, "at": 5, "verdict": verdict, "lost": ["z<"]}
    )
    links = [link for link in re.findall(r'href="([^"]*)"', page) if not link.startswith("#")]
    folders = ("model", "evaluation", "registrations/stabilized")
    assert links == [f"it%2000/{folder}/index.html" for folder in folders]
    for text in ("1.500 mm with 5 components", "<td>1.250</td>", "0.250", "Ended: no gain.", "z&lt;", "<svg"):
        assert text in page, text
    for text in ("s&lt;1&gt;, smile", "&lt;off&gt;", "r&amp;r"):
        assert text in page, text
    assert "–" in page  # no specificity
