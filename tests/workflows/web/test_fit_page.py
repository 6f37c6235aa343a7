"""The page of `gnmreg debug --view` in a headless Chromium: stages appear while they are written."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from registration.capture.native import read_capture
from registration.errors import InputError
from registration.report.stage_snapshots import write_stage
from registration.types import Capture
from tests.registration.capture import small
from tests.registration.report.test_pictures import a_view
from tests.workflows.browser import CHROMIUM, FLAGS, needs_browser
from workflows.web.fit_page import MOTION, PLAIN, TO_SCAN, FitPage

OUTSIDE = np.ones(len(small.ball().vertices), bool)


def stage(folder: Path, name: str, scale: float) -> None:
    """The ball of the small capture, larger or smaller than its scan."""
    mesh = small.ball(scale)
    write_stage(folder, name, (a_view(),), mesh.vertices, mesh.triangles)


@pytest.fixture
def capture(tmp_path: Path) -> Capture:
    return read_capture(small.make(tmp_path / "capture"))


@pytest.fixture
def page(tmp_path: Path, capture: Capture) -> Iterator[FitPage]:
    served = FitPage(tmp_path / "stages", capture, OUTSIDE)
    yield served
    served.close()


def test_stages_are_read_as_they_are_written(page: FitPage, tmp_path: Path) -> None:
    page.refresh()
    assert page.stages == []
    stage(tmp_path / "stages", "00_start", 1.02)
    (tmp_path / "stages" / ".01_pose.ply").write_bytes(b"half of it")
    page.refresh()
    assert page.stages == ["00_start"] and page._stage.value == "00_start"
    stage(tmp_path / "stages", "01_pose", 1.0)
    page.refresh()
    assert (
        page.stages == ["00_start", "01_pose"] and page._stage.value == "01_pose"
    )  # the last stage was selected: the page selects the new last stage
    page._stage.value = "00_start"
    stage(tmp_path / "stages", "02_end", 1.0)
    page.refresh()
    assert page._stage.value == "00_start"  # an operator selected it


def test_colours_are_millimetres(page: FitPage, tmp_path: Path) -> None:
    for name, scale in (("00_start", 1.02), ("01_pose", 1.0)):
        stage(tmp_path / "stages", name, scale)
    page.refresh()
    off_mm = 20 * small.RADIUS_M
    for colours, expected in (
        (TO_SCAN, {"00_start": off_mm, "01_pose": 0.0}),
        (MOTION, {"00_start": 0.0, "01_pose": off_mm}),
    ):
        page._colours.value = colours
        for name, distance in expected.items():
            distances = page._distance_mm(name)
            assert distances is not None and np.abs(distances - distance).max() < 0.02 * off_mm
    page._colours.value = PLAIN
    assert page._distance_mm("01_pose") is None


def test_without_a_scan_there_is_no_distance_to_it(capture: Capture, tmp_path: Path) -> None:
    page = FitPage(tmp_path / "stages", replace(capture, scan=None), OUTSIDE)
    try:
        assert page._colours.options == (MOTION, PLAIN)
    finally:
        page.close()


def test_a_port_in_use_is_refused(page: FitPage, capture: Capture, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=str(page.port)):
        FitPage(tmp_path / "stages", capture, OUTSIDE, page.port)


def in_view(viewer: Any, point: np.ndarray) -> bool:
    """Return whether a point is in front of a browser's camera and inside its image."""
    x, y, z = Rotation.from_quat(viewer.wxyz, scalar_first=True).inv().apply(point - viewer.position)
    high = np.tan(viewer.fov / 2) * z
    return bool(z > 0 and abs(y) < high and abs(x) < viewer.aspect * high)


@needs_browser
def test_an_operator_watches_a_fit(page: FitPage, tmp_path: Path) -> None:
    sync_api = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    with sync_api.sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=list(FLAGS))
        tab = browser.new_page(viewport={"width": 1360, "height": 900})
        requests = []
        tab.on("request", lambda request: requests.append(request.url))
        tab.goto(page.url)
        expect = sync_api.expect
        expect(tab.get_by_text("ball, neutral")).to_be_visible(timeout=60_000)
        tab.set_default_timeout(15_000)
        choice = tab.get_by_role("combobox", name="Stage")
        expect(choice).to_have_value("waiting")
        stage(tmp_path / "stages", "00_start", 1.02)
        expect(choice).to_have_value("00_start")
        stage(tmp_path / "stages", "01_pose", 1.0)
        expect(choice).to_have_value("01_pose")
        expect(tab.locator("h4", has_text=TO_SCAN)).to_be_visible()
        (client,) = page._server.get_clients().values()
        for name in ("Scan", "Cameras"):
            tab.get_by_label(name, exact=True).check()
        tab.wait_for_timeout(500)
        assert all(in_view(client.camera, view.camera.centre) for view in page._capture.views)
        tab.get_by_label("Cameras", exact=True).uncheck()
        tab.wait_for_timeout(500)
        assert not all(in_view(client.camera, view.camera.centre) for view in page._capture.views)
        tab.wait_for_function("document.querySelectorAll('canvas').length > 0")
        image = tab.screenshot()
        browser.close()
    assert len(image) > 20_000
    allowed = (f"http://127.0.0.1:{page.port}/", f"blob:http://127.0.0.1:{page.port}/", "data:")
    assert requests and all(url.startswith(allowed) for url in requests)
    (tmp_path / "watched.png").write_bytes(image)
