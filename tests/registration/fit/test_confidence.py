"""Confidence grows with the views that see a vertex and falls with their disagreement."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from registration.fit.confidence import vertex_confidence
from registration.types import Camera, Pixels, Rendered, Targets

# A square of 2 x 2 at z = 0, facing -z, and a smaller square behind its centre.
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


def rendered_views(views: int, angle: float = 0.0, colour: float = 0.0) -> tuple[Targets, Rendered]:
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
    rotated = torch.tensor([[np.sin(angle), 0.0, -np.cos(angle)]], dtype=torch.float32).expand(count, 3)
    rendered = Rendered(rgb=targets.rgb + colour, normals=rotated, classes=targets.classes, mask=ones)
    return targets, rendered


def test_confidence_grows_with_the_number_of_views():
    confidences = [float(vertex_confidence(VERTICES, TRIANGLES, [rendered_views(views)])[4]) for views in (1, 2, 4)]
    assert confidences == pytest.approx([1 / 2, 2 / 3, 4 / 5], abs=1e-3)


def test_confidence_does_not_depend_on_batches():
    whole = vertex_confidence(VERTICES, TRIANGLES, [rendered_views(4)])
    halves = vertex_confidence(VERTICES, TRIANGLES, [rendered_views(2), rendered_views(2)])
    np.testing.assert_allclose(whole, halves, rtol=1e-6)


def test_hidden_vertices_have_no_confidence():
    assert (vertex_confidence(VERTICES, TRIANGLES, [rendered_views(4)])[5:] == 0).all()


def test_disagreement_reduces_confidence():
    agreeing = vertex_confidence(VERTICES, TRIANGLES, [rendered_views(2)])[4]
    rotated = vertex_confidence(VERTICES, TRIANGLES, [rendered_views(2, angle=np.radians(15))])[4]
    coloured = vertex_confidence(VERTICES, TRIANGLES, [rendered_views(2, colour=0.1)])[4]
    assert rotated == pytest.approx(agreeing / 2, rel=1e-3) and coloured == pytest.approx(agreeing / 2, rel=1e-3)


def test_pixels_that_are_not_compared_give_no_confidence():
    targets, rendered = rendered_views(2)
    none = torch.zeros_like(targets.rgb_weight)
    blind = replace(targets, rgb_weight=none, normal_weight=none)
    assert (vertex_confidence(VERTICES, TRIANGLES, [(blind, rendered)]) == 0).all()


def test_a_view_counts_by_the_cosine_of_its_incidence():
    """The centre as a camera beside the square's axis sees it, alone and with one that looks straight and disagrees."""
    tilt = np.radians(60)
    turn = np.array([[np.cos(tilt), 0, np.sin(tilt)], [0, 1, 0], [-np.sin(tilt), 0, np.cos(tilt)]])
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = turn, [0, 0, 3.0]
    aside = replace(camera(), T_cam_world=pose)
    targets, rendered = rendered_views(1)
    alone = replace(targets, pixels=Pixels.full([aside])), rendered
    assert vertex_confidence(VERTICES, TRIANGLES, [alone])[4] == pytest.approx(0.5 / (1 + 0.5), rel=1e-3)
    straight = rendered_views(1, angle=np.radians(15))  # which agrees by half
    assert vertex_confidence(VERTICES, TRIANGLES, [alone, straight])[4] == pytest.approx(
        (0.5 * 1 + 1 * 0.5) / (1 + 1.5), rel=1e-3
    )
