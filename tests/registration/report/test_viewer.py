"""The mesh in the report can be turned in a browser without a network, and the page fits a narrow screen."""

import base64
import gzip
from pathlib import Path

import numpy as np
import pytest
import trimesh

from registration.report.inputs import ReportInputs, distance_heat_map
from registration.report.page import render_report
from registration.report.viewer import mesh_viewer, vertex_colours
from registration.storage.registration_folder import FILES
from tests.registration.report.test_page import a_registration
from tests.registration.report.test_pictures import a_view
from tests.workflows.browser import CHROMIUM, FLAGS, needs_browser

playwright_api = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")


def a_head():
    """A ball of 10 cm with a texture of three colours."""
    ball = trimesh.creation.icosphere(subdivisions=3, radius=0.1)
    corner_uvs = np.random.default_rng(0).random((len(ball.faces), 3, 2)).astype(np.float32)
    return a_registration(
        vertices=ball.vertices.astype(np.float32),
        triangles=ball.faces.astype(np.int32),
        corner_uvs=corner_uvs,
        texture=np.random.default_rng(1).random((8, 8, 3)).astype(np.float32),
        confidence=np.zeros(len(ball.vertices), np.float32),
        offsets=np.zeros((len(ball.vertices), 3), np.float32),
        figures={
            "views_not_trusted": {"a_camera_with_a_very_long_name_" * 4: "silhouette 35 px off the other views"},
            "notes": ["n" * 150],
            "scan_to_mesh": a_registration().figures["scan_to_mesh"],
        },
        provenance={"command": "gnmreg register " + "/very/long/path" * 20, "capture": "/very/long/path" * 20},
    )


def test_the_file_has_the_first_colours_and_the_others_fit_its_end():
    registration = a_head()
    distances = np.linspace(0, 1, len(registration.vertices))
    mesh = distance_heat_map(registration, distances)
    viewer = mesh_viewer(mesh, vertex_colours(registration, mesh, limit_mm=0.5))
    assert list(viewer.colours) == ["distance from the scan", "texture", "plain"]
    glb, *colours = (gzip.decompress(base64.b64decode(part)) for part in (viewer.glb, *viewer.colours.values()))
    assert glb.endswith(colours[0]) and len({len(part) for part in colours}) == 1
    unmeasured = distance_heat_map(registration, np.full(len(distances), np.nan))
    assert list(vertex_colours(registration, unmeasured, limit_mm=0.5)) == ["texture", "plain"]


@needs_browser
def test_the_mesh_is_shown_offline_and_no_page_scrolls_sideways(tmp_path: Path) -> None:
    registration = a_head()
    heat = distance_heat_map(registration, np.linspace(0, 1, len(registration.vertices)))
    views = tuple(a_view(name=f"cam{number:02}") for number in range(3))
    page = render_report(
        ReportInputs(
            registration=registration,
            subject="subject" * 20,
            expression="smile",
            views=views[:2],
            thumbnails=views,
            class_names=("skin", "left_eye"),
            heat_map=heat,
            versions={"package": "1.0"},
            files=FILES,
        )
    )
    file = tmp_path / "report.html"
    file.write_text(page, encoding="utf-8")
    with playwright_api.sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=list(FLAGS))
        tab = browser.new_page(viewport={"width": 400, "height": 800}, offline=True)
        requests: list[str] = []
        errors: list[str] = []
        tab.on("request", lambda request: requests.append(request.url))
        tab.on("pageerror", lambda error: errors.append(str(error)))
        tab.goto(file.as_uri())
        assert tab.locator("model-viewer").count() == 0, "loaded before anybody asked for it"
        tab.click("#viewer .start")
        tab.wait_for_selector("#viewer[data-state]", timeout=120_000)
        assert tab.get_attribute("#viewer", "data-state") == "shown"
        tab.evaluate("document.querySelectorAll('details').forEach((block) => { block.open = true; })")
        assert tab.evaluate("document.documentElement.scrollWidth") <= 400
        assert not errors and all(url.startswith(("file:", "blob:", "data:")) for url in requests)
        browser.close()


@needs_browser
def test_without_webgl_the_picture_stays_and_the_page_says_so(tmp_path: Path) -> None:
    file = tmp_path / "report.html"
    page = render_report(ReportInputs(registration=a_head(), subject="anna", expression="smile"))
    file.write_text(page, encoding="utf-8")
    with playwright_api.sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox", "--disable-3d-apis"])
        tab = browser.new_page(offline=True)
        tab.goto(file.as_uri())
        tab.click("#viewer .start")
        tab.wait_for_selector("#viewer[data-state=failed]", timeout=120_000)
        assert tab.locator("#viewer .poster").is_visible()
        assert "cannot show the mesh in 3D" in tab.locator("#viewer .note").inner_text()
        browser.close()
