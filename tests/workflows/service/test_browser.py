"""The whole path of docs/service.md in a real farm, sent with curl and followed in a real Chromium.

Six captures are uploaded, one is damaged before it is registered, seen to fail, mended and retried; two are decided at
the gate, one of these decisions is taken back; and the next model waits for a person and says who decided what.
"""

import json
import os
import re
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.conftest import FIXTURES, ROOT
from tests.registration.register import synthetic
from tests.workflows.browser import WIDTHS_PX, launch, needs_browser
from tests.workflows.farm.harness import interruptible
from tests.workflows.service.document import blocks
from workflows.engine.database import default_url
from workflows.engine.reader import QueueReader
from workflows.gate.decisions import DecisionEntry, DecisionLog, current
from workflows.gate.rules import FOLDER, THRESHOLDS, GateThresholds, Limit
from workflows.service.tokens import Tokens

CAPTURES = ("ann/rest", "ann/smile", "bob/rest", "bob/smile", "cid/rest", "dee/rest")
HELD_OUT = ("cid", "dee")
BROKEN = "dee/rest"
BATCH, ROUNDS = "monday", "week"  # runs, as the document calls them
CAMERAS = (1, 2, 4, 6)
NOBODY = GateThresholds(name="nobody is accepted without a person", silhouette_px=Limit(look=0.0, reject=None))


@dataclass(frozen=True, kw_only=True)
class Served:
    """A farm that `gnmreg serve` runs, and the folder from which captures are sent."""

    folder: Path
    laptop: Path
    link: str  # that logs in once
    token: str  # of an operator

    @property
    def url(self) -> str:
        return self.link.partition("/login")[0]

    def run(self, commands: str) -> str:
        """Run commands of the document, and return what they print."""
        environment = {"SERVER": self.url, "GNMREG_TOKEN": self.token, "PATH": os.environ["PATH"]}
        done = subprocess.run(
            ["bash", "-ec", commands], cwd=self.laptop, env=environment, capture_output=True, text=True
        )
        assert done.returncode == 0, (commands, done.stdout, done.stderr)
        return done.stdout

    def upload(self, capture: str, *, replace: bool = False) -> str:
        """Send a capture as the document sends another one."""
        subject, name = capture.split("/")
        commands = blocks("Upload").replace("ann", subject).replace("smile", name)
        if replace:
            commands = commands.replace(f'captures/{capture}"', f'captures/{capture}?replace=true"')
        return self.run(commands)

    def states(self, run: str) -> dict[str, int]:
        """State -> number of jobs of a run, without its flow."""
        return QueueReader(default_url(self.folder)).counts(run, kind="job")

    def decisions(self) -> tuple[DecisionEntry, ...]:
        return tuple(DecisionLog.of_farm(self.folder).read())


def gnmreg(*words: str) -> list[str]:
    return [sys.executable, "-m", "workflows.cli", *words]


@pytest.fixture
def served(tmp_path: Path) -> Iterator[Served]:
    """A service with two workers, started in an empty folder; its model is put there, its captures are elsewhere."""
    folder, laptop = tmp_path / "farm", tmp_path / "laptop"
    laptop.mkdir()
    command = gnmreg("serve", "--folder", str(folder), "--port", "0", "--workers", "2")
    with (tmp_path / "log").open("w") as log:
        process = subprocess.Popen(
            command, cwd=ROOT, stdout=subprocess.PIPE, stderr=log, text=True, preexec_fn=interruptible
        )
    try:
        link = next(match[1] for line in process.stdout or () if (match := re.match(r"Open (\S+)", line)))
        create = gnmreg("token", "create", "--folder", str(folder), "--name", "robot", "--role", "operator")
        token = subprocess.run(create, cwd=ROOT, capture_output=True, text=True, check=True).stdout.strip()
        first = folder / "models" / "first"
        first.mkdir()
        for name in ("tiny_gnm.npz", "head_sparse_68.txt"):
            (first / name).write_bytes((FIXTURES / name).read_bytes())
        (folder / FOLDER).mkdir()
        NOBODY.write(folder / FOLDER / THRESHOLDS)
        yield Served(folder=folder, laptop=laptop, link=link, token=token)
    finally:
        process.terminate()
        process.wait(60)


@needs_browser
@pytest.mark.slow
def test_from_captures_to_the_next_model(served: Served) -> None:
    sync_api = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    send_a_batch(served)
    with launch(sync_api) as browser:
        tab = browser.new_page(viewport={"width": 1280, "height": 900})
        tab.set_default_timeout(60_000)
        problems: list[str] = []
        tab.on("console", lambda message: problems.append(message.text) if message.type == "error" else None)
        tab.on("pageerror", lambda error: problems.append(str(error)))
        tab.on("request", lambda sent: problems.append(sent.url) if not sent.url.startswith(served.url) else None)
        see = sync_api.expect
        see.set_options(timeout=60_000)  # the machine may be busy
        mend_the_broken_one(served, tab, see)
        look_at_the_run(served, tab, see)
        decided = decide_two(served, tab, see)
        build_the_next_model(served, tab, see, decided)
        open_every_page(served, tab, see)
        log_in_as_a_viewer(served, tab, see)
    assert problems == []


def send_a_batch(served: Served) -> None:
    """Upload six captures, damage one on the service's disk, and register all."""
    random = np.random.default_rng(4)
    for capture in CAPTURES:
        subject, name = capture.split("/")
        if name == "rest":
            identity = random.normal(0.0, 0.6, len(synthetic.IDENTITY))
        tags = {"held_out": True} if subject in HELD_OUT else {}
        expression = "neutral" if name == "rest" else name
        synthetic.make(served.laptop / capture, expression, subject, identity, CAMERAS, **tags)
        assert capture in served.upload(capture)
    image = next(iter(sorted((served.folder / "captures" / BROKEN / "images").iterdir())))
    image.write_bytes(image.read_bytes()[:1000])
    subjects = json.dumps(sorted({capture.split("/")[0] for capture in CAPTURES}))
    sent = served.run(blocks("Submit").replace('["ann"]', subjects))
    assert json.JSONDecoder().raw_decode(sent)[0]["total"] == len(CAPTURES)


def mend_the_broken_one(served: Served, tab: Any, see: Any) -> None:
    """See it fail, send it again, retry it."""
    tab.goto(served.link)
    see(tab.get_by_role("heading", name="Overview")).to_be_visible()
    failures = tab.get_by_role("link", name=re.compile("bad input"))
    see(failures.first).to_be_visible(timeout=300_000)  # the page follows the queue
    failures.first.click()
    tab.locator(".wall a", has_text=BROKEN.split("/")[1]).click()
    see(tab.get_by_role("heading", name="What failed")).to_be_visible()
    see(tab.get_by_text("images/").first).to_be_visible()
    assert "gnmreg debug" in tab.locator("#debug").inner_text()
    served.upload(BROKEN, replace=True)
    tab.get_by_role("button", name="Retry", exact=True).click()
    see(tab.get_by_text(re.compile(r"Retry: \d jobs"))).to_be_visible()
    see(tab.get_by_role("heading", name="What failed")).to_have_count(0, timeout=300_000)
    wait(lambda: served.states(BATCH) == {"done": len(CAPTURES)})


def look_at_the_run(served: Served, tab: Any, see: Any) -> None:
    """Find every capture on the wall, and open one with the keyboard."""
    tab.goto(f"{served.url}/runs/{BATCH}")
    see(tab.locator(".wall li")).to_have_count(len(CAPTURES))
    see(tab.locator(".wall img")).to_have_count(len(CAPTURES))
    assert all(tab.locator(".wall img").evaluate_all("images => images.map(i => i.complete && i.naturalWidth > 0)"))
    for key in ("j", "j", "Enter"):
        tab.keyboard.press(key)
    see(tab.locator("iframe.report")).to_be_visible()
    see(tab.frame_locator("iframe.report").get_by_text("Head registration")).to_be_attached()
    see(tab.locator("pre.log")).to_contain_text("attempt 1 of 3")


def decide_two(served: Served, tab: Any, see: Any) -> DecisionEntry:
    """Accept a neutral, reject another capture and take that back; return the decision that holds."""
    tab.goto(f"{served.url}/gate/{BATCH}?show=all")
    count = len(CAPTURES)
    see(tab.get_by_text(f"1 of {count}")).to_be_visible()
    see(tab.locator(".sheet img").first).to_be_visible()
    assert tab.locator("h1").inner_text() == CAPTURES[0]
    tab.keyboard.press("a")
    see(tab.get_by_text(f"2 of {count}")).to_be_visible()
    tab.keyboard.press("r")
    tab.keyboard.type("eyes <closed>")
    tab.keyboard.press("Enter")
    see(tab.get_by_text(f"3 of {count}")).to_be_visible()
    tab.keyboard.press("u")
    see(tab.get_by_role("heading", name=CAPTURES[1])).to_be_visible()
    entries = served.decisions()
    assert [entry.decision for entry in entries] == ["accept", "reject", "undo"]
    assert entries[1].reason == "eyes <closed>"
    (held,) = current(entries).values()
    assert held.name == CAPTURES[0]
    return held


def build_the_next_model(served: Served, tab: Any, see: Any, decided: DecisionEntry) -> None:
    """Start a coregistration, decide on what waits, continue it, and find the decisions in the model's manifest."""
    small = '"iterations": 1, "anatomy": "keep", "components": [2], '  # as the tiny model has neither teeth nor more
    served.run(blocks("Next model").replace('"gate"', f'{small}"gate"'))
    tab.goto(f"{served.url}/coregistrations/{ROUNDS}")
    waiting = "3 registrations wait for a person"  # that of the fourth was decided on as part of the batch
    see(tab.get_by_text(waiting).first).to_be_visible(timeout=300_000)
    tab.get_by_role("link", name="at the gate").click()
    for left in (3, 2, 1):
        see(tab.get_by_role("link", name=f"{left} wait for a person")).to_be_visible()
        if tab.locator("h1").inner_text() == "bob/smile":
            tab.locator("#reason").fill("mouth open")
            tab.get_by_role("button", name="reject").click()
        else:
            tab.keyboard.press("a")
    tab.get_by_role("button", name="Continue the run").click()
    queue = QueueReader(default_url(served.folder))
    wait(lambda: queue.rows([ROUNDS])[ROUNDS].state == "done")

    model = served.folder / "results" / ROUNDS / "it00" / "model"
    gate = json.loads((model / "gnm_head.manifest.json").read_text())["gate"]
    assert (gate["policy"], gate["waiting"], gate["accepted"]) == ("person", 0, 3)
    assert gate["left_out"] == {"bob/smile": "console: mouth open"}
    found = {entry["name"]: (entry["decision"], entry["who"]) for entry in gate["decisions"]}
    accepted = dict.fromkeys(("ann/rest", "ann/smile", "bob/rest"), ("accept", "console"))
    assert found == accepted | {"bob/smile": ("reject", "console")}
    assert gate["log_head"] == DecisionLog.of_farm(served.folder).verify().sha256
    (held,) = (entry for entry in gate["decisions"] if entry["name"] == decided.name)
    assert (held["sequence"], held["content_id"]) == (decided.sequence, decided.content_id)
    tab.goto(f"{served.url}/coregistrations/{ROUNDS}")
    see(tab.get_by_text("all 1 rounds done").or_(tab.get_by_text("too many failures")).first).to_be_visible()
    tab.get_by_role("link", name="model", exact=True).first.click()
    see(tab.get_by_text("mouth open").first).to_be_visible()


def open_every_page(served: Served, tab: Any, see: Any) -> None:
    """Open all kinds of pages in windows of both widths: none scrolls sideways."""
    run, gate = f"/runs/{BATCH}", f"/gate/{BATCH}?show=decided"
    pages = ("/", "/jobs", run, f"/captures/{BATCH}/{BROKEN}", "/gate", gate, "/models", f"/coregistrations/{ROUNDS}")
    for path in pages:
        for width in WIDTHS_PX:
            tab.set_viewport_size({"width": width, "height": 900})
            tab.goto(served.url + path)
            see(tab.locator("h1")).to_be_visible()
            assert tab.evaluate("document.documentElement.scrollWidth") <= width, (path, width)


def log_in_as_a_viewer(served: Served, tab: Any, see: Any) -> None:
    """A viewer sees the run and cannot act on it."""
    tab.get_by_role("button", name="Log out").click()
    see(tab.get_by_label("Token")).to_be_visible()
    tab.goto(f"{served.url}/runs/{BATCH}")
    see(tab.get_by_label("Token")).to_be_visible()
    tab.get_by_label("Token").fill(Tokens(served.folder / "service").create("eve", ["viewer"]))
    tab.get_by_role("button", name="Log in").click()
    see(tab.get_by_role("heading", name=BATCH)).to_be_visible()
    see(tab.get_by_role("button", name="Cancel the run")).to_have_count(0)


def wait(condition: Callable[[], bool], within_s: float = 300.0) -> None:
    until = time.monotonic() + within_s
    while not condition():
        assert time.monotonic() < until
        time.sleep(0.3)
