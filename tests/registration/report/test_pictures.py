"""Comparison images and their numbers, of views with known differences."""

import base64
from dataclasses import fields, replace

import cv2
import numpy as np
import pytest
import torch
import trimesh

from registration.frames import srgb_to_linear
from registration.geometry.rasterizer import rasterize
from registration.report import heat_map, pictures
from registration.report.heat_map import render_heat_map, scale_limit_mm
from registration.report.inputs import HeatMap, ReportView, report_views, thumbnail
from registration.report.pictures import (
    BACKGROUND,
    COLOUR_SCALE,
    OUTLINE,
    data_uri,
    scale_colours,
    view_images,
)
from registration.types import Camera, Pixels, Rendered, Targets

HEIGHT, WIDTH = 40, 30


@pytest.fixture(autouse=True)
def coarse_heat_maps(monkeypatch):
    monkeypatch.setattr(heat_map, "_OVERSAMPLING", 1)


def a_view(**changes) -> ReportView:
    """A square subject.

    The rendering is 0.1 brighter (sRGB), its normals are rotated by 10 degrees, and one row of its classes is wrong.
    """
    mask = np.zeros((HEIGHT, WIDTH))
    mask[10:30, 5:25] = 1
    grey = srgb_to_linear(np.full((HEIGHT, WIDTH, 3), 0.4))
    normals = np.zeros((HEIGHT, WIDTH, 3))
    normals[mask > 0] = [0, 0, 1]
    rotated = np.zeros_like(normals)
    rotated[mask > 0] = [np.sin(np.radians(10)), 0, np.cos(np.radians(10))]
    classes = np.where(mask > 0, 0, -1)
    rendered_classes = classes.copy()
    rendered_classes[10] = np.where(classes[10] < 0, -1, 1)
    fields = dict(
        name="cam",
        target_rgb=grey,
        rendered_rgb=srgb_to_linear(np.full((HEIGHT, WIDTH, 3), 0.5)) * mask[..., None],
        compared=np.ones((HEIGHT, WIDTH), bool),
        target_mask=mask,
        rendered_mask=mask,
        target_normals=normals,
        rendered_normals=rotated,
        target_classes=classes,
        rendered_classes=rendered_classes,
    )
    return ReportView(**{**fields, **changes})


def arrays(view: ReportView) -> list[tuple[str, np.ndarray]]:
    return [(f.name, value) for f in fields(view) if isinstance(value := getattr(view, f.name), np.ndarray)]


def test_images_show_the_differences():
    rows = {name: [p for _, p in row] for name, row in view_images(a_view()).rows.items()}
    assert list(rows) == ["Colour", "Normals", "Classes"] and all(len(row) == 3 for row in rows.values())
    inside, outside = (20, 15), (2, 2)
    colour, normal, wrong = (rows[name][2] for name in rows)
    np.testing.assert_allclose(colour[inside], scale_colours(np.array(0.1 / pictures.COLOUR_LIMIT)), atol=1)
    np.testing.assert_allclose(normal[inside], scale_colours(np.array(10 / pictures.ANGLE_LIMIT)), atol=1)
    assert tuple(colour[outside]) == tuple(normal[outside]) == tuple(wrong[outside]) == BACKGROUND
    red = (wrong == COLOUR_SCALE[-2]).all(-1)
    assert red[10, 5:25].all() and red.sum() == 20
    assert abs(int(rows["Colour"][1][inside][0]) - 128) <= 1  # 0.5 sRGB


def test_the_outline_of_the_rendering_is_drawn_on_the_capture():
    capture = view_images(a_view()).rows["Colour"][0][1]
    outlined = (capture == OUTLINE).all(-1)
    rows, columns = np.nonzero(outlined)
    assert (rows.min(), rows.max(), columns.min(), columns.max()) == (10, 29, 5, 24)
    assert not outlined[12:28, 7:23].any()
    np.testing.assert_allclose(capture[20, 15], 0.4 * 255, atol=1)


def test_missing_targets_of_a_view_are_omitted():
    images = view_images(a_view(target_normals=None, target_classes=None, target_mask=None))
    assert list(images.rows) == ["Colour"]


def test_a_thumbnail_shows_the_colours_of_a_view_in_small():
    tall = thumbnail(replace(a_view(), **{name: np.repeat(np.repeat(a, 10, 0), 10, 1) for name, a in arrays(a_view())}))
    small = thumbnail(a_view())  # already small
    assert tall.rendered_mask.shape == (150, 112) and small.rendered_mask.shape == (HEIGHT, WIDTH)
    images = view_images(tall)
    assert list(images.rows) == ["Colour"] and images.name == "cam"
    colour = images.rows["Colour"][2][1]
    np.testing.assert_allclose(colour[75, 56], scale_colours(np.array(0.1 / pictures.COLOUR_LIMIT)), atol=1)
    assert tuple(colour[2, 2]) == BACKGROUND


def test_large_views_are_downscaled():
    def tall(array):
        return np.repeat(np.repeat(array, 40, 0), 40, 1)

    view = a_view()
    arrays = {k: tall(v) for k, v in vars(view).items() if isinstance(v, np.ndarray)}
    image = view_images(replace(view, **arrays)).rows["Colour"][0][1]
    assert image.shape == (pictures.MAX_IMAGE_HEIGHT, 480, 3)


def test_scale_runs_from_first_to_last_colour():
    np.testing.assert_array_equal(
        scale_colours(np.array([-1.0, 0, 1, 9])), [COLOUR_SCALE[0], COLOUR_SCALE[0], COLOUR_SCALE[-1], COLOUR_SCALE[-1]]
    )


def test_data_uri_is_a_jpeg_of_the_image():
    image = np.zeros((16, 16, 3), np.uint8) + np.array([200, 60, 20], np.uint8)
    head, body = data_uri(image).split(",")
    assert head == "data:image/jpeg;base64"
    decoded = cv2.imdecode(np.frombuffer(base64.b64decode(body), np.uint8), cv2.IMREAD_COLOR)[..., ::-1]
    np.testing.assert_allclose(decoded.astype(int), image, atol=6)


@pytest.mark.parametrize(("p95", "limit"), [(0.05, 0.1), (0.19, 0.2), (0.3, 0.5), (50.0, 10.0)])
def test_scale_limit(p95, limit):
    assert scale_limit_mm(np.append(np.full(99, p95), np.nan)) == limit
    assert scale_limit_mm(np.array([np.nan])) == heat_map.LIMITS_MM[0]


def a_heat_map(**changes) -> HeatMap:
    """A sphere in the world; distances only on the head frame's +x half. The head is rotated by 90 degrees about y."""
    ball = trimesh.creation.icosphere(subdivisions=4, radius=0.1)
    vertices = np.asarray(ball.vertices)
    T_head_world = np.eye(4)
    T_head_world[:3, :3] = [[0, 0, 1], [0, 1, 0], [-1, 0, 0]]
    head_x = vertices @ T_head_world[0, :3]
    fields = dict(
        vertices=vertices + [5, 6, 7],
        triangles=np.asarray(ball.faces),
        distance_mm=np.where(head_x > 0.001, 0.5, np.nan),
        T_head_world=T_head_world,
    )
    return HeatMap(**{**fields, **changes})


def hue_fraction(image, colour) -> float:
    """Fraction of the pixels of the head that have the colour's hue."""
    covered = (np.abs(image.astype(int) - BACKGROUND) > 3).any(-1)
    expected, actual = np.array(colour, float), image[covered].astype(float)
    cosine = actual @ expected / np.linalg.norm(actual, axis=1) / np.linalg.norm(expected)
    return float((cosine > 0.999).mean())


def test_heat_maps_show_distances_on_their_side_and_grey_where_unmeasured():
    images = dict(render_heat_map(a_heat_map(), limit_mm=1.0))
    colour = scale_colours(np.array(0.5))
    assert hue_fraction(images["subject's left"], colour) > 0.8
    assert hue_fraction(images["subject's right"], heat_map.UNMEASURED) > 0.8
    front = images["front"]
    center = front.shape[1] // 2
    assert hue_fraction(front[:, center + 15 :], colour) > 0.95  # the subject's left is on the image's right
    assert hue_fraction(front[:, : center - 15], heat_map.UNMEASURED) > 0.95


def test_the_head_fills_the_images():
    for _, image in render_heat_map(a_heat_map(), limit_mm=1.0):
        rows, columns = np.nonzero((np.abs(image.astype(int) - BACKGROUND) > 3).any(-1))
        spans = np.ptp(columns) / image.shape[1], np.ptp(rows) / image.shape[0]
        assert max(spans) == pytest.approx(0.94, abs=0.02)
        assert abs(columns.min() + columns.max() - image.shape[1]) < 6


def test_report_views_of_targets_and_a_rendering():
    """Two views of 8 x 6; the targets list only the pixels around the head."""
    mask = torch.zeros(2, 8, 6)
    mask[:, 2:6, 1:5] = 1
    camera = Camera(width_px=6, height_px=8, intrinsics=np.eye(3), T_cam_world=np.eye(4))
    pixels = Pixels.from_mask((camera, camera), torch.nn.functional.max_pool2d(mask, 3, 1, 1) > 0)
    listed = mask[pixels.view.long(), pixels.y.long(), pixels.x.long()]
    classes = torch.nn.functional.one_hot((listed * 2).long(), 3).float()
    nothing = torch.zeros(len(listed), 3)
    targets = Targets(
        names=("cam0", "cam1"),
        class_names=("skin", "eye", "lip"),
        pixels=pixels,
        rgb=nothing + 0.25,
        rgb_weight=listed,
        normals=nothing,
        normal_weight=listed * 0,
        mask=listed,
        mask_weight=listed * 0 + 1,
        classes=classes,
        class_weight=listed,
        landmarks={},
        px_per_head=8.0,
    )
    rendered = Rendered(rgb=nothing + 0.5, normals=nothing, classes=classes * listed[:, None], mask=listed)
    views = report_views(targets, rendered)
    assert [view.name for view in views] == ["cam0", "cam1"]
    for view in views:
        np.testing.assert_array_equal(view.target_mask, mask[0])
        np.testing.assert_array_equal(view.target_classes, np.where(mask[0] > 0, 2, -1))
        np.testing.assert_array_equal(view.rendered_classes, view.target_classes)
        assert view.target_normals is None and view.target_rgb[3, 3, 0] == 0.25 and view.target_rgb[0, 5, 0] > 0.9
        np.testing.assert_array_equal(view.rendered_mask, view.target_mask)
    without_targets = replace(targets, mask_weight=listed * 0, class_weight=listed * 0)
    assert all(
        view.target_mask is None and view.target_classes is None for view in report_views(without_targets, rendered)
    )


def test_heat_cameras_see_the_mesh_they_are_fitted_to():
    head = np.asarray(trimesh.creation.icosphere(subdivisions=2, radius=0.1).vertices)
    triangles = np.asarray(trimesh.creation.icosphere(subdivisions=2, radius=0.1).faces)
    for camera in heat_map._cameras(head, heat_map.SIZE).values():
        assert 0.4 < (rasterize(head, triangles, camera)[0] >= 0).mean() < 0.9
