"""Renders docs/stabilization.jpg: the review page on the synthetic population, in a headless Chromium.

    python -m docs.pictures.stabilization

Needs Debian's `chromium`. Two kinds of head motion are added to a third of the samples.
"""

import shutil
import tempfile
from pathlib import Path

import cv2
import numpy as np
from playwright.sync_api import sync_playwright

from bench.support import performances
from coregister.first_model import assembly as anatomy_of
from coregister.first_model import build, makehuman, population
from registration.geometry.rigid import motion_fields
from registration.model import gnm_npz
from registration.stabilize.components import HeadGeometry, regional_components
from registration.stabilize.stabilized_folder import StoredComponents
from tests.workflows.web.test_review import CHROMIUM, FLAGS
from workflows.steps.stabilize import mean_displacements
from workflows.web.review import ReviewPage
from workflows.web.review_state import ReviewState

PICTURE = Path(__file__).parents[1] / "stabilization.jpg"
SIZE = {"width": 1500, "height": 960}
WAIT_MS = 6000  # until the animation has started


def stored(head: HeadGeometry) -> StoredComponents:
    """Return the components of true expressions with added head motion."""
    anatomy = anatomy_of.build_assembly(makehuman.read(makehuman.fetch()), population.mean_person())
    truths = [performances.true_subject(anatomy, 1000 + number) for number in range(16)]
    rng = np.random.default_rng(5)
    twists = rng.normal(size=(2, 2, 3))
    twists *= np.array([np.radians(1.0), 2e-3])[:, None] / np.linalg.norm(twists, axis=2, keepdims=True)
    count = sum(len(truth.labels) for truth in truths)
    strengths = rng.normal(size=(count, 2)) * (rng.permutation(count) % 3 == 0)[:, None]
    moved = np.tensordot(strengths @ twists.reshape(2, 6), motion_fields(head.points), 1)
    displacements = [d.astype(np.float32) for d in moved + np.concatenate([t.vertices - t.neutral for t in truths])]
    labels = tuple(label for truth in truths for label in truth.labels)
    components = regional_components(displacements, labels, head)
    return StoredComponents(
        components=tuple(components),
        subjects=tuple(truth.name for truth in truths for _ in truth.labels),
        names=labels,
        labels=labels,
        mean_displacement=mean_displacements(displacements, components),
    )


def main() -> None:
    head = HeadGeometry.from_model(gnm_npz.read(build.bootstrap()))
    with tempfile.TemporaryDirectory() as folder, sync_playwright() as playwright:
        page = ReviewPage(ReviewState(stored(head), head, Path(folder) / "log.jsonl", "picture"), port=0)
        browser = playwright.chromium.launch(executable_path=CHROMIUM or shutil.which("chromium"), args=list(FLAGS))
        tab = browser.new_page(viewport=SIZE)
        tab.goto(page.url)
        tab.get_by_text("Software WebGL rendering detected").locator("xpath=ancestor::*[@role='alert'][1]").get_by_role(
            "button"
        ).click()
        tab.wait_for_timeout(WAIT_MS)
        picture = cv2.imdecode(np.frombuffer(tab.screenshot(), np.uint8), cv2.IMREAD_COLOR)
        cv2.imwrite(str(PICTURE), picture, [cv2.IMWRITE_JPEG_QUALITY, 88])
        browser.close()
        page.close()


if __name__ == "__main__":
    main()
