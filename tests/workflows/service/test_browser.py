"""A real farm followed in a real Chromium: every page, a broken capture that is mended, two decisions, one undone."""

import re
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from registration.fit.recipes import preview
from registration.options import RegisterOptions
from tests.conftest import ROOT
from tests.registration.register import synthetic
from tests.workflows.browser import WIDTHS_PX, launch, needs_browser
from tests.workflows.farm.harness import interruptible
from workflows.engine.database import default_url
from workflows.engine.process import migrate
from workflows.engine.reader import QueueReader
from workflows.farm.batch import batch_jobs, submit_batch
from workflows.gate.decisions import DecisionLog, current
from workflows.service.tokens import Tokens

RUN = "today"
BROKEN = f"{RUN}/captures/broken"


@pytest.fixture
def farm(tmp_path: Path) -> Iterator[tuple[Path, str]]:
    """A farm of one worker with three captures, one of them broken; and the link that logs in."""
    captures = tmp_path / "captures"
    for name in ("neutral", "smile"):
        synthetic.make(captures / name, name)
    (captures / "broken").mkdir()
    (captures / "broken" / "capture.toml").write_text('expression = "<b>smile</b>"\n')
    stages = tuple(replace(stage, steps=6) for stage in preview().stages[:2])
    options = RegisterOptions(recipe=replace(preview(), stages=stages))
    folder = tmp_path / "farm"
    migrate(default_url(folder))
    folders = [str(captures / name) for name in ("neutral", "smile", "broken")]
    out = str(folder / "results" / RUN)
    submit_batch(default_url(folder), batch_jobs(folders, model=str(synthetic.MODEL), out=out, options=options))
    command = [sys.executable, "-m", "workflows.cli", "serve", "--folder", str(folder), "--port", "0", "--workers", "1"]
    command += ["--root", str(captures), str(synthetic.MODEL.parent)]
    with (tmp_path / "log").open("w") as log:
        served = subprocess.Popen(
            command, cwd=ROOT, stdout=subprocess.PIPE, stderr=log, text=True, preexec_fn=interruptible
        )
    try:
        link = next(match[1] for line in served.stdout or () if (match := re.match(r"Open (\S+)", line)))
        yield folder, link
    finally:
        served.terminate()
        served.wait(60)


@needs_browser
@pytest.mark.slow
def test_a_batch_is_followed_mended_and_decided(farm, tmp_path):
    sync_api = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    folder, link = farm
    base = link.partition("/login")[0]
    with launch(sync_api) as browser:
        tab = browser.new_page(viewport={"width": 1280, "height": 900})
        tab.set_default_timeout(60_000)
        problems: list[str] = []
        tab.on("console", lambda message: problems.append(message.text) if message.type == "error" else None)
        tab.on("pageerror", lambda error: problems.append(str(error)))
        tab.on("request", lambda request: problems.append(request.url) if not request.url.startswith(base) else None)
        see = sync_api.expect
        tab.goto(link)
        see(tab.get_by_role("heading", name="Overview")).to_be_visible()
        failures = tab.get_by_role("link", name=re.compile("bad input"))
        see(failures.first).to_be_visible(timeout=300_000)  # the page follows the queue
        failures.first.click()
        tab.locator(".wall a", has_text="broken").click()
        see(tab.get_by_role("heading", name="What failed")).to_be_visible()
        see(tab.get_by_text("capture.toml").first).to_be_visible()
        assert "gnmreg debug" in tab.locator("#debug").inner_text()

        mend(tmp_path / "captures")
        tab.get_by_role("button", name="Retry", exact=True).click()
        see(tab.get_by_text(re.compile(r"Retry: \d jobs"))).to_be_visible()
        see(tab.get_by_role("heading", name="What failed")).to_have_count(0, timeout=300_000)
        wait(lambda: QueueReader(default_url(folder)).counts(RUN, kind="job") == {"done": 3})

        tab.goto(f"{base}/runs/{RUN}")
        see(tab.locator(".wall li")).to_have_count(3)
        see(tab.locator(".wall img")).to_have_count(3)
        assert all(tab.locator(".wall img").evaluate_all("images => images.map(i => i.complete && i.naturalWidth > 0)"))
        tab.keyboard.press("j")
        tab.keyboard.press("j")
        tab.keyboard.press("Enter")
        see(tab.locator("iframe.report")).to_be_visible()
        report = tab.frame_locator("iframe.report")
        see(report.get_by_text("Head registration")).to_be_attached()
        see(tab.locator("pre.log")).to_contain_text("attempt 1 of 3")

        tab.goto(f"{base}/gate/{RUN}?show=all")
        see(tab.get_by_text("1 of 3")).to_be_visible()
        see(tab.locator(".sheet img").first).to_be_visible()
        first = tab.locator("h1").inner_text()
        tab.keyboard.press("a")
        see(tab.get_by_text("2 of 3")).to_be_visible()
        second = tab.locator("h1").inner_text()
        assert second != first
        tab.keyboard.press("r")
        tab.keyboard.type("eyes <closed>")
        tab.keyboard.press("Enter")
        see(tab.get_by_text("3 of 3")).to_be_visible()
        tab.keyboard.press("u")
        see(tab.get_by_role("heading", name=second)).to_be_visible()
        entries = DecisionLog.of_farm(folder).read()
        assert [entry.decision for entry in entries] == ["accept", "reject", "undo"]
        assert [entry.name for entry in current(entries).values()] == [first] and entries[1].reason == "eyes <closed>"

        run, gate = f"/runs/{RUN}", f"/gate/{RUN}?show=decided"
        for path in ("/", "/jobs", run, f"/captures/{BROKEN}", "/gate", gate, "/models"):
            for width in WIDTHS_PX:
                tab.set_viewport_size({"width": width, "height": 900})
                tab.goto(base + path)
                see(tab.locator("h1")).to_be_visible()
                assert tab.evaluate("document.documentElement.scrollWidth") <= width, (path, width)
        tab.get_by_role("button", name="Log out").click()
        see(tab.get_by_label("Token")).to_be_visible()
        tab.goto(f"{base}/runs/{RUN}")
        see(tab.get_by_label("Token")).to_be_visible()
        tab.get_by_label("Token").fill(Tokens(folder / "service").create("eve", ["viewer"]))
        tab.get_by_role("button", name="Log in").click()
        see(tab.get_by_role("heading", name=RUN)).to_be_visible()
        see(tab.get_by_role("button", name="Cancel the run")).to_have_count(0)
    assert problems == []


def mend(captures: Path) -> None:
    for file in sorted((captures / "smile").rglob("*")):
        target = captures / "broken" / file.relative_to(captures / "smile")
        if file.is_dir():
            target.mkdir(exist_ok=True)
        else:
            target.write_bytes(file.read_bytes())


def wait(condition: Any, within_s: float = 300.0) -> None:
    until = time.monotonic() + within_s
    while not condition():
        assert time.monotonic() < until
        time.sleep(0.3)
