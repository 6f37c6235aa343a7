"""A headless Chromium with software WebGL."""

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")
FLAGS = (
    *("--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--disable-background-networking"),
    *("--disable-component-update", "--disable-sync", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"),
)
WIDTHS_PX = (400, 1280)  # of the smallest telephone and of a window that pages are tested with
needs_browser = pytest.mark.skipif(CHROMIUM is None, reason="no chromium on the path")


@contextmanager
def launch(sync_api: Any) -> Iterator[Any]:
    """Yield the browser. `sync_api`: the module of playwright, which may be missing."""
    with sync_api.sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=list(FLAGS))
        yield browser
        browser.close()


def sideways_px(browser: Any, page: Path) -> dict[int, int]:
    """Return by how many pixels a page is wider than windows of `WIDTHS_PX`: 0 if it does not scroll sideways."""
    excess = {}
    for width in WIDTHS_PX:
        tab = browser.new_page(viewport={"width": width, "height": 900})
        tab.goto(page.as_uri())
        excess[width] = tab.evaluate("document.documentElement.scrollWidth") - width
        tab.close()
    return excess
