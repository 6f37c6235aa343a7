"""A subject's page."""

import re

from workflows.pages.subject import render_subject_page
from workflows.records.subject import CaptureRow, SubjectRecord


def a_subject(*rows: CaptureRow) -> SubjectRecord:
    return SubjectRecord(subject="a<b>", model="ab" * 32, recipe="draft", neutral="rest", rows=rows)


def test_the_page_shows_every_row_and_is_self_contained():
    figures = {"scan_to_mesh": {"face": {"mean_mm": 0.1234, "median_mm": 0.0456}}, "drift": {"face": {"mean_mm": 0.5}}}
    page = render_subject_page(
        a_subject(
            CaptureRow(
                name="rest", expression="neutral", status="converged", figures=figures, seconds=66.4, folder="rest"
            ),
            CaptureRow(name="big <smile>", expression="x&y", status="failed", reason="<off>", folder="big <smile>"),
            CaptureRow(name="gone", expression="gone", status="error", reason="lost"),
            CaptureRow(name="later", expression="later"),
        ),
        {"rest": "data:image/jpeg;base64,AAAA"},
    )
    assert "<b>" not in page and "<smile>" not in page and "<off>" not in page
    assert "a&lt;b&gt;" in page and "x&amp;y" in page and "&lt;off&gt;" in page
    for text in ("0.123", "0.046", "0.500", '<td class="num">66</td>', "lost", "1 of 4", "1 is waiting"):
        assert text in page, text
    links = re.findall(r'(?:src|href)="([^"]*)"', page)
    assert set(links) == {"data:image/jpeg;base64,AAAA", "rest/report.html", "big%20%3Csmile%3E/report.html"}
    assert not re.search("<script|@import|url", page)
    rows = re.split("<tr[ >]", page)
    assert "waiting" in rows[-1] and "href" not in rows[-1] and "href" not in rows[-2]


def test_a_verdict_stands_before_the_status_and_residuals_are_shown():
    residuals = {"overall": {"silhouette_px": 7.25}}
    figures = {"residuals": residuals, "verdict": {"level": "wrong", "reasons": ["the outline is 7 px off"]}}
    page = render_subject_page(
        a_subject(CaptureRow(name="rest", expression="rest", status="converged", figures=figures, folder="rest")), {}
    )
    assert '<span class="badge wrong">wrong</span><small>converged</small>' in page
    assert "the outline is 7 px off" in page and "silhouette, px" in page and ">7.2</td>" in page
    assert "scan to mesh" not in page
