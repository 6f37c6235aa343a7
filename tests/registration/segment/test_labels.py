"""Labels of a fitted head, on a rendered bald head, and on one with hair and shirt drawn onto it."""

from dataclasses import replace

import numpy as np
import pytest

from registration.capture.native import read_capture
from registration.capture.pixels import read_coverage, read_labels, read_photograph
from registration.model import gnm_npz
from registration.model.regions import neck_other
from registration.render.studio.skin import depth_inside_hairline
from registration.segment.fitted import CLASSES, FOREIGN, INDEX, FittedHead
from registration.segment.labels import fitted_labels, head_sphere
from registration.segment.masks import first_masks
from registration.segment.views import SegmentView
from tests.conftest import SHARED, needs_shared

MODEL = SHARED / "data/gnm/gnm_head_reconstructed.npz"
VIEWS = (4, 14)
ERROR_M = 7e-4


@pytest.fixture(scope="module")
def scene():
    """A bald head in two views, and a fit of it with errors of about a millimetre."""
    capture = read_capture(SHARED / "data/captures/gnm_identity_a/neutral")
    data = gnm_npz.read(MODEL)
    truth = np.load(capture.ground_truth)["vertices"]
    wave = np.sin(truth @ np.array([40.0, 55.0, 35.0]))[:, None] * np.array([0.6, 0.5, 0.6]) * 2 * ERROR_M
    head = FittedHead(truth + wave, data)
    views = []
    for view in (capture.views[index] for index in VIEWS):
        image, camera = read_photograph(view)
        views.append(SegmentView(name=view.name, image=image, camera=camera))
    return capture, head, views


@pytest.fixture(scope="module")
def bald(scene):
    """The labels that are found, the true ones by name, and the true masks."""
    capture, head, views = scene
    sphere = head_sphere(head)
    masks = first_masks(views, sphere.centre, sphere.radius_m)
    found = fitted_labels(views, masks, head)
    names = np.array(capture.classes)
    chosen = [capture.views[index] for index in VIEWS]
    labels = [names[read_labels(view.segmentation, view.camera, capture.classes)] for view in chosen]
    return found, labels, [read_coverage(view) for view in chosen]


def overlap(found: np.ndarray, true: np.ndarray) -> float:
    return (found & true).sum() / max((found | true).sum(), 1)


@needs_shared
def test_nothing_foreign_is_found_on_a_bald_head(bald):
    found, _, true_masks = bald
    for one, mask in zip(found, true_masks, strict=True):
        foreign = np.isin(one.labels, [INDEX[name] for name in FOREIGN])
        assert foreign.sum() < 0.005 * (mask > 0.5).sum()


@needs_shared
def test_the_mask_is_the_true_one(bald):
    found, _, true_masks = bald
    for one, mask in zip(found, true_masks, strict=True):
        assert overlap(one.mask > 0.5, mask > 0.5) > 0.995


@needs_shared
@pytest.mark.parametrize(("name", "least"), [("skin", 0.9), ("ears", 0.8), ("neck_other", 0.85)])
def test_the_models_classes_are_where_they_are(bald, name, least):
    found, labels, _ = bald
    for one, true in zip(found, labels, strict=True):
        assert overlap(one.labels == INDEX[name], true == name) > least


@needs_shared
def test_labels_lie_inside_the_mask(bald):
    for one in bald[0]:
        assert one.labels.max() < len(CLASSES)
        assert ((one.labels == INDEX["background"]) == (one.mask < 0.5)).mean() > 0.998


@needs_shared
def test_drawn_hair_and_clothes_are_left_out_and_the_face_is_not(scene):
    _, head, views = scene
    rng = np.random.default_rng(7)
    covers = {"hair": depth_inside_hairline(head.data) > 0.008, "cloth": neck_other(head.data)}
    low = head.data.template_vertex_positions[covers["cloth"], 1]
    covers["cloth"] &= head.data.template_vertex_positions[:, 1] < np.quantile(low, 0.6)
    drawn, regions = [], []
    for view in views:
        fitted, image = head.view(view.camera), view.image.copy()
        noise = rng.uniform(0.6, 1.4, (*image.shape[:2], 1))
        here = {name: head.at_pixels(members.astype(float), fitted) > 0.5 for name, members in covers.items()}
        for name, colour in (("hair", (40, 28, 20)), ("cloth", (50, 70, 150))):
            image[here[name]] = (noise * colour)[here[name]].astype(np.uint8)
        drawn.append(replace(view, image=image))
        regions.append(here)
    sphere = head_sphere(head)
    masks = first_masks(drawn, sphere.centre, sphere.radius_m)
    for one, here, view in zip(fitted_labels(drawn, masks, head), regions, views, strict=True):
        left_out = np.isin(one.labels, [INDEX[name] for name in (*FOREIGN, "unlabelled")])
        assert left_out[here["hair"]].mean() > 0.9
        assert left_out[here["cloth"]].mean() > 0.45
        face = (head.view(view.camera).labels == INDEX["skin"]) & ~here["hair"] & ~here["cloth"]
        assert left_out[face].mean() < 0.15
