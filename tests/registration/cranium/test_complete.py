"""Craniums of heads whose shape is known, hidden and completed."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from coregister.anatomy.cranium_model import under_hair
from registration.cranium.complete import CraniumCompletion, CraniumSettings
from registration.cranium.conditional import patch_areas, predict
from registration.cranium.deformation import band_weights, deform, smootherstep
from registration.cranium.registered import cranium_figure, cranium_note, hidden_share, write_cranium
from registration.geometry.topology import vertex_areas
from registration.model import regions
from tests.registration.cranium.smooth_heads import auxiliary_model, smooth_heads, tiny

HAIR = under_hair(tiny())
HIDDEN = np.where(HAIR, 0.0, 0.9)


def mean_mm(a: np.ndarray, b: np.ndarray, rows: np.ndarray) -> float:
    return float(1000 * np.linalg.norm(a - b, axis=1)[rows].mean())


def test_a_hidden_cranium_is_predicted_in_any_pose_and_the_rest_stays():
    complete = CraniumCompletion(tiny(), auxiliary_model())
    for head in smooth_heads(3, seed=1):
        turned = Rotation.from_rotvec([0.2, -0.5, 0.1]).apply(head) + (0.3, 0.1, -0.2)
        spoiled = turned + 0.02 * HAIR[:, None]
        completed = complete(spoiled, HIDDEN)
        assert completed is not None
        assert (completed.vertices[~completed.hidden] == spoiled[~completed.hidden]).all()
        assert completed.hidden.sum() > 0.9 * HAIR.sum() and not (completed.hidden & ~HAIR).any()
        error = mean_mm(completed.vertices, turned, completed.hidden)
        assert error < 0.1 and error < 0.1 * mean_mm(auxiliary_model().mean, head, completed.hidden)


def test_skin_that_is_seen_is_not_completed():
    complete = CraniumCompletion(tiny(), auxiliary_model())
    head = smooth_heads(1, seed=2)[0]
    assert complete(head, np.full(len(head), 0.5)) is None
    speck = np.full(len(head), 0.5)
    speck[np.flatnonzero(HAIR)[0]] = 0
    assert complete(head, speck) is None
    everywhere = CraniumCompletion(tiny(), auxiliary_model(), CraniumSettings(min_area_cm2=0.001))
    completed = everywhere(head, speck)
    assert completed is not None and completed.hidden.sum() == 1


def test_a_hidden_neck_joins_without_a_step_and_keeps_its_place():
    data, head = tiny(), smooth_heads(1, seed=3)[0]
    neck = regions.neck_other(data) & regions.exterior(data)
    moved = head + np.where(neck, 0.004, 0.0)[:, None] * (0, 0, 1)  # the registration's neck: elsewhere than the mean's
    completed = CraniumCompletion(data, auxiliary_model())(moved, np.where(neck | regions.cranium(data), 0.0, 0.9))
    assert completed is not None
    lowest = neck & (head[:, 1] < np.quantile(head[neck, 1], 0.3)) & completed.hidden
    assert lowest.any() and mean_mm(completed.vertices, moved, lowest) < 1.0


def test_the_deviation_says_how_far_the_prediction_may_be_off():
    model, heads = auxiliary_model(), smooth_heads(20, seed=4)
    seen = patch_areas(model.mean, tiny().triangles) * (regions.head_skin(tiny()) & ~HAIR)
    rng = np.random.default_rng(0)
    blurred = replace(model, noise=0.003)
    ratios = []
    for head in heads:
        noise = rng.normal(0, 0.003, head.shape) / np.sqrt(np.maximum(seen, 1e-6))[:, None]
        predicted = predict(blurred, head + np.where(seen[:, None] > 0, noise, 0), seen)
        ratios.append(np.linalg.norm(predicted.vertices - head, axis=1)[HAIR] / predicted.deviation[HAIR])
    assert 0.3 < np.sqrt(np.mean(np.square(ratios))) < 1.5
    assert predict(blurred, heads[0], seen * 0.01).deviation[HAIR].mean() > predicted.deviation[HAIR].mean()


def test_smootherstep_has_flat_ends():
    t = np.array([-1.0, 0.0, 1e-3, 0.5, 1 - 1e-3, 1.0, 2.0])
    assert smootherstep(t) == pytest.approx([0, 0, 1e-8, 0.5, 1 - 1e-8, 1, 1], abs=2e-9)


def test_the_band_rises_with_the_distance_from_seen_skin():
    data = tiny()
    points = data.template_vertex_positions.astype(np.float64)
    weights = band_weights(points, data.triangles, HAIR, 0.035)
    assert (weights[~HAIR] == 0).all() and weights[HAIR].max() == 1
    top = np.flatnonzero(HAIR)[points[HAIR, 1].argmax()]
    assert weights[top] == 1 and 0 < np.median(weights[HAIR]) <= 1
    assert (band_weights(points, data.triangles, np.ones(len(points), bool), 0.035) == 1).all()


def test_a_displacement_fades_without_a_step():
    """A plane whose left half is displaced: the rest follows smoothly, and far away it is where it should be."""
    n, size = 41, 0.004
    x, y = np.meshgrid(np.arange(n), np.arange(n))
    points = np.stack([x.ravel(), y.ravel(), 0 * x.ravel()], 1) * size
    corner = (np.arange(n - 1)[:, None] * n + np.arange(n - 1)).ravel()
    quads = np.stack([corner, corner + 1, corner + n + 1, corner + n], 1)
    triangles = np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
    hidden = x.ravel() > 10
    displacement = np.where(hidden, 0.0, 0.005)[:, None] * np.array([0.0, 0.0, 1.0])
    weights = band_weights(points, triangles, hidden, 0.035)
    found = deform(points, triangles, displacement, weights, hidden, length_m=0.015)
    assert (found[~hidden] == displacement[~hidden]).all()
    row = found[:, 2].reshape(n, n)[n // 2]
    assert abs(row[-1]) < 2e-4 and abs(row[11] - row[10]) < 3e-4  # a sharp step would be 5 mm
    assert np.abs(np.diff(row, 2)).max() < 4e-4
    assert vertex_areas(points, triangles).sum() == pytest.approx((40 * size) ** 2)


def test_what_a_registration_says_of_it(tmp_path):
    data, model, head = tiny(), auxiliary_model(), smooth_heads(1, seed=6)[0]
    completed = CraniumCompletion(data, model)(head, HIDDEN)
    assert completed is not None and 0.3 < hidden_share(data, HIDDEN) < 0.9
    figure = cranium_figure(data, HIDDEN, model, completed, completed.vertices - head)
    assert figure["completed_by"] == "model" and figure["heads"] == 40 and figure["deviation_mm"]["mean"] > 0
    assert cranium_note(figure, wanted=True, neutral=False) is None
    without = cranium_figure(data, HIDDEN, None, None, None)
    note = cranium_note(without, wanted=True, neutral=False)
    assert note is not None and f"{100 * without['hidden_share']:.0f} %" in note
    assert cranium_note(without, wanted=False, neutral=False) is None
    assert cranium_note(without, wanted=True, neutral=True) is None
    write_cranium(completed, tmp_path)
    with np.load(tmp_path / "cranium.npz") as arrays:
        assert {name: arrays[name].shape for name in arrays} == {
            name: (len(head),) for name in ("hidden", "weights", "deviation")
        }
