"""Labels of a fitted head, on a rendered bald head and on photographs of a person with hair, beard and shirt."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from registration.capture.native import read_capture
from registration.capture.pixels import read_labels, read_mask
from registration.model import gnm_npz
from registration.segment.fitted import CLASSES, FOREIGN, INDEX, FittedHead
from registration.segment.labels import fitted_labels, head_sphere
from registration.segment.masks import first_masks
from registration.segment.views import SegmentView
from tests.conftest import SHARED, needs_shared

MODEL = SHARED / "data/gnm/gnm_head_reconstructed.npz"
VIEWS = (4, 14)
ERROR_M = 7e-4


@pytest.fixture(scope="module")
def bald():
    """A bald head: the true labels and masks of two views, and those from a fit with errors of about a millimetre."""
    capture = read_capture(SHARED / "data/captures/gnm_identity_a/neutral")
    data = gnm_npz.read(MODEL)
    truth = np.load(capture.ground_truth)["vertices"]
    wave = np.sin(truth @ np.array([40.0, 55.0, 35.0]))[:, None] * np.array([0.6, 0.5, 0.6]) * 2 * ERROR_M
    head = FittedHead(truth + wave, data)
    chosen = [capture.views[index] for index in VIEWS]
    views = [
        SegmentView(
            name=view.name,
            image=np.ascontiguousarray(cv2.imread(str(view.image))[..., ::-1]),
            camera=replace(view.camera, distortion=()),
        )
        for view in chosen
    ]
    sphere = head_sphere(head)
    masks = first_masks(views, sphere.centre, sphere.radius_m)
    found = fitted_labels(views, masks, head)
    names = np.array(capture.classes)
    labels = [names[read_labels(view.segmentation, view.camera, capture.classes)] for view in chosen]
    true_masks = [read_mask(view.mask, view.camera) / 255 for view in chosen]
    return found, labels, true_masks


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
