"""Views that deviate from the others get lower weights and are named; a fit that is bad everywhere names none."""

import numpy as np
import pytest
import torch

from registration.fit.view_weights import ViewErrors, ViewWeights, view_errors
from registration.types import Camera, Pixels, Rendered, Targets

NAMES = tuple(f"cam{i:02}" for i in range(8))


def errors(outline=None, landmarks=None, brightness=None) -> ViewErrors:
    def filled(changes: dict[int, float] | None, usual: float) -> torch.Tensor:
        values = torch.full((8,), usual)
        for view, value in (changes or {}).items():
            values[view] = value
        return values

    return ViewErrors(
        names=NAMES,
        outline_px=filled(outline, 1.0),
        landmark_px=filled(landmarks, 2.0),
        brightness=filled(brightness, -1.0),
    )


def test_consistent_views_have_full_weight():
    weights = ViewWeights.from_errors(errors())
    assert not weights.notes and (weights.geometry == 1).all() and (weights.colour == 1).all()


def test_a_fit_that_is_bad_in_all_views_excludes_none():
    everywhere = {view: 20.0 for view in range(8)}
    assert not ViewWeights.from_errors(errors(outline=everywhere, landmarks=everywhere)).notes


@pytest.mark.parametrize("what", ["outline", "landmarks"])
def test_a_shifted_view_is_named_and_has_little_weight(what):
    weights = ViewWeights.from_errors(errors(**{what: {3: 35.0}}))
    assert list(weights.notes) == ["cam03"] and "35 px off" in weights.notes["cam03"]
    assert weights.geometry[3] < 0.01 and weights.colour[3] < 0.01
    assert (weights.geometry[torch.arange(8) != 3] == 1).all()


@pytest.mark.parametrize("log_gain, message", [(-6.0, "times as bright"), (np.log(2.5), "2.5 times as bright")])
def test_a_black_or_overexposed_view_keeps_its_shape_weights(log_gain, message):
    weights = ViewWeights.from_errors(errors(brightness={5: -1.0 + log_gain}))
    assert list(weights.notes) == ["cam05"] and message in weights.notes["cam05"]
    assert weights.colour[5] == 0 and weights.geometry[5] == 1


def test_gains_of_ten_percent_do_not_reduce_weights():
    assert not ViewWeights.from_errors(errors(brightness={i: -1.0 + 0.1 * (-1) ** i for i in range(8)})).notes


def test_a_view_without_landmarks_or_mask_has_full_weight():
    weights = ViewWeights.from_errors(errors(outline={2: float("nan")}, landmarks={2: float("nan")}))
    assert not weights.notes and torch.isfinite(weights.geometry).all()


def test_the_reason_names_views():
    message = errors(outline={3: 14.0, 7: 14.0}, landmarks={1: 30.0}).disagreement(6.0)
    assert message == "landmarks off by 30 px in views cam01; silhouette off by 14 px in views cam03, cam07"
    assert errors().disagreement(6.0) is None


def targets(shift_px: int = 0) -> Targets:
    """Two views of 64 x 64 px with a square subject of 32 px; in the second it is shifted."""
    cameras = tuple(
        Camera(width_px=64, height_px=64, intrinsics=np.diag([64.0, 64.0, 1.0]), T_cam_world=np.eye(4))
        for _ in range(2)
    )
    pixels = Pixels.full(cameras)
    mask = torch.zeros(2, 64, 64)
    mask[0, 16:48, 16:48] = 1
    mask[1, 16:48, 16 + shift_px : 48 + shift_px] = 1
    coverage = pixels.of_image(mask)
    ones = torch.ones_like(coverage)
    return Targets(
        names=("a", "b"),
        class_names=("skin",),
        pixels=pixels,
        rgb=torch.stack([coverage * 0.5] * 3, -1),
        rgb_weight=coverage,
        normals=torch.zeros(len(coverage), 3),
        normal_weight=coverage,
        mask=coverage,
        mask_weight=ones,
        classes=coverage[:, None],
        class_weight=coverage,
        landmarks={"68": torch.ones(2, 4, 3)},
        px_per_head=32.0,
    )


def test_errors_of_a_shifted_silhouette():
    """Shifted by 8 of 32 px: 512 pixels differ, on an outline of 124, in px at 512 of head height."""
    straight = targets()
    rendered = Rendered(rgb=straight.rgb, normals=straight.normals, classes=straight.classes, mask=straight.mask)
    measured = view_errors(rendered, targets(shift_px=8), torch.tensor([1.0, 2.0]))
    assert measured.outline_px[0] == 0
    assert measured.outline_px[1].item() == pytest.approx(2 * 8 * 32 / 124 * 16)
    torch.testing.assert_close(measured.brightness, torch.full((2,), np.log(0.5), dtype=torch.float32))


def test_weights_are_applied_to_the_targets_of_the_selected_views():
    weights = ViewWeights(
        geometry=torch.tensor([1.0, 0.01, 1.0]), colour=torch.tensor([1.0, 1.0, 0.0]), notes={"x": "y"}
    )
    batch = targets()
    applied = weights.apply(batch, [1, 2])
    first = batch.pixels.view == 0
    for name in ("normal_weight", "mask_weight", "class_weight"):
        before, after = getattr(batch, name), getattr(applied, name)
        torch.testing.assert_close(after[first], 0.01 * before[first])
        torch.testing.assert_close(after[~first], before[~first])
    assert (applied.rgb_weight[~first] == 0).all() and (applied.rgb_weight[first] == batch.rgb_weight[first]).all()
    assert (applied.landmarks["68"][0, :, 2] == 0).all() and (applied.landmarks["68"][1, :, 2] == 1).all()
    assert ViewWeights.uniform(3).apply(batch, [1, 2]) is batch
