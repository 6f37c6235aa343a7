"""Residuals in the images, of views with known differences."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from registration.evaluate.names import RESIDUALS
from registration.evaluate.residuals import FAR_MM, far_landmarks, residual_figures, view_residuals
from registration.frames import srgb_to_linear
from registration.types import Camera, Capture, Pixels, Rendered, Targets, View


def square_subject() -> tuple[Targets, Rendered]:
    """Two views of 64 x 64 px with a square subject of 32 px, which the mesh covers exactly.

    In the second view the mesh is 10 levels brighter, its normals are rotated by 10 degrees, and a quarter of its
    labels are wrong.
    """
    camera = Camera(width_px=64, height_px=64, intrinsics=np.diag([64.0, 64.0, 1.0]), T_cam_world=np.eye(4))
    pixels = Pixels.full((camera, camera))
    mask = torch.zeros(2, 64, 64)
    mask[:, 16:48, 16:48] = 1
    covered, second = pixels.of_image(mask), (pixels.view == 1).float()
    grey, brighter = srgb_to_linear(np.array([100, 110]) / 255).tolist()
    normals = torch.tensor([0.0, 0.0, 1.0]) * covered[:, None]
    rotated = torch.tensor([np.sin(np.radians(10)), 0.0, np.cos(np.radians(10))], dtype=torch.float32)
    lower = ((pixels.y >= 40) & (pixels.view == 1)).float() * covered
    skin = torch.stack([covered, torch.zeros_like(covered)], -1)
    targets = Targets(
        names=("a", "b"),
        class_names=("skin", "ears"),
        pixels=pixels,
        rgb=torch.full((len(covered), 3), grey) * covered[:, None],
        rgb_weight=covered,
        normals=normals,
        normal_weight=covered,
        mask=covered,
        mask_weight=torch.ones_like(covered),
        classes=skin,
        class_weight=covered,
        landmarks={},
        px_per_head=32.0,
    )
    rendered = Rendered(
        rgb=(grey + (brighter - grey) * second[:, None]) * covered[:, None].repeat(1, 3),
        normals=torch.where(second[:, None] > 0, rotated * covered[:, None], normals),
        classes=torch.stack([covered - lower, lower], -1),
        mask=covered,
    )
    return targets, rendered


def test_residuals_of_known_differences() -> None:
    targets, rendered = square_subject()
    views = view_residuals(targets, rendered, torch.tensor([1.5, float("nan")]))
    assert views["a"] == pytest.approx(
        {"silhouette_px": 0, "normals_deg": 0, "colour_levels": 0, "labels_percent": 0, "landmarks_px": 1.5}, abs=1e-2
    )
    assert views["b"] == pytest.approx(
        {"silhouette_px": 0, "normals_deg": 10, "colour_levels": 10, "labels_percent": 25}, rel=1e-3, abs=1e-6
    )


def test_what_a_view_lacks_has_no_residual() -> None:
    targets, rendered = square_subject()
    nothing = torch.zeros_like(targets.mask)
    bare = replace(targets, normal_weight=nothing, rgb_weight=nothing, class_weight=nothing, mask_weight=nothing)
    assert view_residuals(bare, rendered, torch.full((2,), torch.nan)) == {"a": {}, "b": {}}
    without_classes = replace(targets, classes=targets.classes[:, :0])
    assert "labels_percent" not in view_residuals(without_classes, rendered, torch.zeros(2))["a"]


def test_overall_is_the_median_of_the_trusted_views() -> None:
    views = {"a": {"normals_deg": 1.0}, "b": {"normals_deg": 3.0}, "c": {"normals_deg": 90.0, "colour_levels": 5.0}}
    assert residual_figures(views, ["c"]) == {"overall": {"normals_deg": 2.0}, "views": views}
    assert residual_figures(views)["overall"] == {"normals_deg": 3.0, "colour_levels": 5.0}
    assert residual_figures({}) == {"overall": {}, "views": {}}


def test_values_have_units() -> None:
    assert RESIDUALS["normals_deg"].text(2.04) == "2.0°"
    assert RESIDUALS["silhouette_px"].text(0.5) == "0.5\N{NO-BREAK SPACE}px"


def test_far_landmarks_count_by_their_distance_at_the_depth_of_the_mesh(tmp_path) -> None:
    """A camera a metre away with a focal length of 1,000 px: a pixel is a millimetre."""
    intrinsics = np.array([[1000.0, 0, 320], [0, 1000.0, 240], [0, 0, 1]])
    camera = Camera(width_px=640, height_px=480, intrinsics=intrinsics, T_cam_world=np.eye(4))
    points = np.column_stack([np.linspace(-0.1, 0.1, 8), np.zeros(8), np.ones(8)])
    shown = np.column_stack([camera.project(points)[0], np.ones(8)])
    shown[0, 0] += FAR_MM - 0.5  # near enough
    shown[1:4, 1] += FAR_MM + 0.5  # far
    shown[4] = (0, 0, 0.2)  # not confident
    shown[5, :2] = np.nan
    view = View(name="a", camera=camera, image=tmp_path / "a.png", landmarks={"68": shown, "other": shown})
    capture = Capture(root=tmp_path, subject="s", expression="e", classes=(), views=(view,), scan=None)
    assert far_landmarks(capture, {"68": points}) == {"percent": 50.0, "counted": 6}
    wide = replace(view, landmark_spread_px={"68": np.full(8, 4.0)})  # three standard deviations are 12 mm
    assert far_landmarks(replace(capture, views=(wide,)), {"68": points}) == {"percent": 0.0, "counted": 6}
    assert far_landmarks(capture, {"dense": points}) is None
