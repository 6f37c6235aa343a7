"""GLB files in a browser: three.js, within the viewer of the report, reads parts, texture and morph targets."""

import base64
from dataclasses import replace
from importlib.resources import files
from pathlib import Path

import numpy as np
import pytest

from registration.export.glb import glb_bytes
from registration.export.registrations import head_of_registration
from registration.report.viewer import VIEWER_FILE
from tests.registration.export.heads import DATA, a_registration
from tests.workflows.browser import launch, needs_browser

playwright_api = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")

READ = """() => {
  const viewer = document.querySelector('model-viewer');
  const scene = viewer[Object.getOwnPropertySymbols(viewer).find((symbol) => symbol.description === 'scene')];
  const found = [];
  scene.traverse((item) => {
    if (!item.isMesh || !item.morphTargetDictionary) return;
    const shape = item.geometry.morphAttributes.position[item.morphTargetDictionary['jaw']];
    const length = (k) => Math.hypot(shape.getX(k), shape.getY(k), shape.getZ(k));
    const largest = Array.from({length: shape.count}, (_, k) => length(k));
    found.push({
      material: item.material.name, names: Object.keys(item.morphTargetDictionary),
      vertices: item.geometry.attributes.position.count, faces: item.geometry.index.count / 3,
      texture: item.material.map ? item.material.map.image.width : 0, largest: Math.max(...largest),
    });
  });
  return found;
}"""


@needs_browser
def test_a_browser_shows_the_head_with_its_shapes(tmp_path: Path) -> None:
    head = head_of_registration(a_registration(), DATA, name="anna")
    shapes = {"brow": DATA.expression_basis[0].astype(np.float64), "jaw": DATA.expression_basis[3].astype(np.float64)}
    glb = base64.b64encode(glb_bytes(replace(head, shapes=shapes))).decode()
    code = files("registration.report.templates").joinpath(VIEWER_FILE).read_text("utf-8")
    page = tmp_path / "page.html"
    viewer = f'<model-viewer src="data:model/gltf-binary;base64,{glb}" style="width:300px;height:300px"></model-viewer>'
    page.write_text(f'<script type="module">{code}</script>{viewer}', encoding="utf-8")
    with launch(playwright_api) as browser:
        tab = browser.new_page(viewport={"width": 400, "height": 400})
        errors: list[str] = []
        tab.on("pageerror", lambda error: errors.append(str(error)))
        tab.goto(page.as_uri())
        tab.wait_for_function("document.querySelector('model-viewer').loaded === true", timeout=120_000)
        parts = {part["material"]: part for part in tab.evaluate(READ)}
        assert not errors
    assert set(parts) == set(head.topology.materials)
    for number, name in enumerate(head.topology.materials):
        chosen = head.topology.triangle_material == number
        rows = np.unique(head.topology.triangles[chosen])
        assert parts[name]["names"] == ["brow", "jaw"] and parts[name]["texture"] == len(head.texture)
        assert parts[name]["faces"] == chosen.sum() and parts[name]["vertices"] >= len(rows)
        largest = np.linalg.norm(shapes["jaw"][rows], axis=1).max()
        assert parts[name]["largest"] == pytest.approx(largest, abs=1e-7)
