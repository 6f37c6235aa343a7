"""Confidence grows with the views that see a vertex and falls with their disagreement."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from registration.fit.confidence import vertex_confidence
from registration.types import Camera, Pixels, Rendered, Targets

# A square of 2 x 2 at z = 0, facing -z, and a smaller one behind its middle.
VERTICES = np.array(
    [[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0], [0, 0, 0], [-0.2, -0.2, 1], [0.2, -0.2, 1], [0, 0.2, 1]],
    np.float32,
)
TRIANGLES = np.array([[4, 1, 0], [4, 2, 1], [4, 3, 2], [4, 0, 3], [5, 7, 6]])


def camera() -> Camera:
    intrinsics = np.array([[40.0, 0, 32], [0, 40.0, 32], [0, 0, 1]])
    T_cam_world = np.eye(4)
    T_cam_world[2, 3] = 3.0  # 3 m in front
    return Camera(width_px=64, height_px=64, intrinsics=intrinsics, T_cam_world=T_cam_world)


def drawn(views: int, angle: float = 0.0, colour: float = 0.0) -> tuple[Targets, Rendered]:
    """Targets that face the camera, and a rendering rotated and brightened relative to them."""
    pixels = Pixels.full([camera()] * views)
    count = len(pixels.view)
    normals = torch.tensor([[0.0, 0, -1]]).expand(count, 3)
    ones = torch.ones(count)
    targets = Targets(
        names=tuple("abcdefgh"[:views]),
        class_names=("skin",),
        pixels=pixels,
        rgb=torch.full((count, 3), 0.4),
        rgb_weight=ones,
        normals=normals,
        normal_weight=ones,
        mask=ones,
        mask_weight=ones,
        classes=ones[:, None],
        class_weight=ones,
        landmarks={},
        px_per_head=64.0,
    )
    turned = torch.tensor([[np.sin(angle), 0.0, -np.cos(angle)]], dtype=torch.float32).expand(count, 3)
    rendered = Rendered(rgb=targets.rgb + colour, normals=turned, classes=targets.classes, mask=ones)
    return targets, rendered


def test_more_views_make_more_confident():
    middle = [float(vertex_confidence(VERTICES, TRIANGLES, [drawn(views)])[4]) for views in (1, 2, 4)]
    assert middle == pytest.approx([1 / 2, 2 / 3, 4 / 5], abs=1e-3)


def test_batches_add_up():
    whole = vertex_confidence(VERTICES, TRIANGLES, [drawn(4)])
    halves = vertex_confidence(VERTICES, TRIANGLES, [drawn(2), drawn(2)])
    np.testing.assert_allclose(whole, halves, rtol=1e-6)


def test_what_is_hidden_has_none():
    assert (vertex_confidence(VERTICES, TRIANGLES, [drawn(4)])[5:] == 0).all()


def test_disagreement_takes_it_away():
    sure = vertex_confidence(VERTICES, TRIANGLES, [drawn(2)])[4]
    turned = vertex_confidence(VERTICES, TRIANGLES, [drawn(2, angle=np.radians(15))])[4]
    coloured = vertex_confidence(VERTICES, TRIANGLES, [drawn(2, colour=0.1)])[4]
    assert turned == pytest.approx(sure / 2, rel=1e-3) and coloured == pytest.approx(sure / 2, rel=1e-3)


def test_pixels_that_are_not_compared_see_nothing():
    targets, rendered = drawn(2)
    none = torch.zeros_like(targets.rgb_weight)
    blind = replace(targets, rgb_weight=none, normal_weight=none)
    assert (vertex_confidence(VERTICES, TRIANGLES, [(blind, rendered)]) == 0).all()
