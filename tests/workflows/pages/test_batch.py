"""The page of a batch: escaped, self-contained, and sorted and filtered in a browser."""

import re
from dataclasses import replace
from pathlib import Path

import pytest

from tests.workflows.browser import launch, needs_browser
from tests.workflows.records.test_batch import a_row
from workflows.pages.batch import PAGE_ROWS, render_batch_page
from workflows.records.batch import BatchRow, BatchTable, ranked


def render(*rows: BatchRow, live: bool = True) -> str:
    return render_batch_page(
        BatchTable(run="june", written="NOW", rows=ranked(rows), live=live), csv_file="captures.csv"
    )


def test_the_page_is_escaped_and_links_files_beside_it() -> None:
    folder = "a b/ü#1?/attempt-1"
    page = render(
        a_row("a<b>/1", report=f"{folder}/registration/report.html", thumbnail=f"{folder}/thumbnail.jpg"),
        a_row("c", "failed", status="bad input", reason="<script>alert(1)</script>"),
        a_row("d", "waiting"),
    )
    quoted = "a%20b/%C3%BC%231%3F/attempt-1"
    links = re.findall(r'(?:src|href)="([^"]*)"', page)
    report = f"{quoted}/registration/report.html"
    assert sorted(links) == sorted(["captures.csv", report, report, f"{quoted}/thumbnail.jpg"])
    assert "a&lt;b&gt;/1" in page and "&lt;script&gt;alert(1)" in page and "<b>/1" not in page
    assert page.count("<script>") == 1 and not re.search(r"@import|url\(|https?:", page)
    assert "bad input, 1" in page and "needs a look, 1" in page
    assert "the page is written again" in page
    assert "ended or was stopped" in render(live=False)


def test_the_names_of_folders_that_a_key_cannot_have_are_shown() -> None:
    page = render(replace(a_row("_nn_b/rest"), source="/data/ünn b/rest"), a_row("x/rest"))
    assert "<small>ünn b/rest</small>" in page and page.count("<small>") == 1


def test_a_page_of_thousands_of_captures_is_small() -> None:
    folder = "s{0:04d}/e1/attempt-0123456789abcdef0123456789abcdef"
    rows = [
        a_row(
            f"s{n:04d}/e1",
            mean_mm=0.2,
            seconds=50.0,
            reason="loss flat",
            report=f"{folder.format(n)}/registration/report.html",
            thumbnail=f"{folder.format(n)}/thumbnail.jpg",
        )
        for n in range(1000)
    ]
    assert len(render(*rows)) < 700 * len(rows)


@needs_browser
def test_rows_are_sorted_filtered_and_unfolded(tmp_path: Path) -> None:
    sync_api = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    rows = [a_row(f"s{n:03d}", mean_mm=0.2 + 0.001 * (n % 7), seconds=float(n)) for n in range(PAGE_ROWS + 20)]
    rows += [a_row("lost", "failed", status="died", reason="out of memory"), a_row("later", "waiting")]
    (tmp_path / "index.html").write_text(render(*rows))
    with launch(sync_api) as browser:
        tab = browser.new_page(viewport={"width": 1280, "height": 900})
        tab.goto((tmp_path / "index.html").as_uri())
        tab.set_default_timeout(15_000)

        def names() -> list[str]:
            return tab.locator("td.name").all_inner_texts()

        assert len(names()) == PAGE_ROWS and names()[0] == "lost"
        assert tab.get_by_role("status").inner_text() == "100 of 122"
        tab.get_by_role("button", name="Show 22 more").click()
        assert len(names()) == 122 and names()[-1] == "later" and not tab.locator("button.more").is_visible()
        time = tab.get_by_role("button", name="time, s")
        time.click()
        assert names()[:2] == ["s119", "s118"]  # the slowest
        time.click()
        assert names()[0] == "s000"
        time.click()
        assert names()[0] == "lost"  # as ranked
        tab.get_by_role("button", name="capture").click()
        assert names()[:2] == ["later", "lost"]
        tab.get_by_role("searchbox").fill("MEMORY out")
        assert names() == ["lost"] and tab.get_by_role("status").inner_text() == "1 of 1 that match, 122 in all"
        tab.get_by_role("searchbox").fill("")
        tab.get_by_role("combobox").select_option("waiting, 1")
        assert names() == ["later"]
        tab.get_by_role("combobox").select_option("needs a look, 1")
        assert names() == ["lost"]
