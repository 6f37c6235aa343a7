"""Targets from a small capture: a ball with a cap of hair, a neck and an eye, seen by five cameras."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.ndimage import distance_transform_edt

from registration.capture.native import read_capture
from registration.capture.native_writer import CaptureDescription, ViewArrays, write_capture
from registration.geometry.surface_views import SurfaceViews
from registration.targets.classes import class_map
from registration.targets.pyramid import build_pyramid
from registration.types import Targets
from tests.registration.capture import small

CLASSES = ("background", "skin", "neck_other", "hair", "left_eye")
LEVELS = 3
VALUES = ("rgb", "normals", "mask", "classes")
WEIGHTS = ("rgb_weight", "normal_weight", "mask_weight", "class_weight")


def labels_of(direction: np.ndarray) -> np.ndarray:
    """Labels by the position on the ball; `direction` is its outward unit normal in the world."""
    x, y, z = np.moveaxis(direction, -1, 0)
    labels = np.where(y < -0.6, 2, np.where(y > 0.55, 3, 1))
    return np.where((x - 0.35) ** 2 + (y - 0.1) ** 2 + np.minimum(z, 0) < 0.04, 4, labels)


def labelled_view(name: str, yaw_rad: float, distortion: tuple[float, ...] = ()) -> ViewArrays:
    view = small.synthetic_view(name, small.camera(yaw_rad, distortion=distortion))
    world = view.normals @ view.camera.T_cam_world[:3, :3]
    return replace(view, labels=np.where(view.mask, labels_of(world), 0).astype(np.uint8))


def capture_of(root: Path, views: list[ViewArrays]):
    write_capture(root, views, CaptureDescription(subject="ball", expression="neutral", classes=CLASSES))
    return read_capture(root)


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    views = [labelled_view(f"cam{i}", yaw_rad, small.DISTORTIONS["OPENCV"]) for i, yaw_rad in enumerate(small.YAWS_RAD)]
    return capture_of(tmp_path_factory.mktemp("targets") / "ball", views)


@pytest.fixture(scope="module")
def pyramid(capture):
    return build_pyramid(capture, class_map(CLASSES), finest_head_px=10_000, levels=LEVELS)


def images(level: Targets, name: str) -> np.ndarray:
    """One channel as images (N, H, W, D)."""
    values = getattr(level, name).float()
    return level.pixels.image(values.reshape(len(values), -1)).numpy()


def world_directions(camera) -> tuple[np.ndarray, np.ndarray]:
    """The ball's outward normal at each pixel's centre, and the distance of the ray from the ball's outline, m."""
    y, x = np.mgrid[: camera.height_px, : camera.width_px] + 0.5
    rays = np.stack([x, y, np.ones_like(x)], -1) @ np.linalg.inv(camera.intrinsics).T @ camera.T_cam_world[:3, :3]
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    along = -(rays @ camera.centre)
    miss = np.linalg.norm(camera.centre + along[..., None] * rays, axis=-1)
    depth = along - np.sqrt(np.maximum(small.RADIUS_M**2 - miss**2, 0))
    return (camera.centre + depth[..., None] * rays) / small.RADIUS_M, small.RADIUS_M - miss


@pytest.mark.parametrize("level", range(LEVELS))
def test_cameras_match_windows_and_levels(pyramid, level):
    assert_channels_match_cameras(pyramid[level], least=2000 / 4**level)


@pytest.mark.parametrize("finest_head_px", (74, 60, 48))
def test_heads_are_reduced_by_fractions(capture, pyramid, finest_head_px):
    """Of 87 px, by less than a half: cameras, landmarks and channels are those of the new pixels."""
    levels = build_pyramid(capture, class_map(CLASSES), finest_head_px=finest_head_px, levels=2)
    reduction = 87 / finest_head_px
    for number, targets in enumerate(levels):
        assert_channels_match_cameras(targets, least=1500 / (reduction * 2**number) ** 2)
        assert targets.px_per_head == pytest.approx(pyramid[number].px_per_head / reduction, rel=0.02)
        for camera, view in zip(targets.pixels.cameras, targets.landmarks["68"].numpy(), strict=True):
            np.testing.assert_allclose(view[:, :2], camera.project(small.landmarks_68())[0], atol=0.02)


def test_heads_a_little_larger_stay_as_they_are(capture, pyramid):
    same = build_pyramid(capture, class_map(CLASSES), finest_head_px=81, levels=1)[0]
    assert torch.equal(same.rgb, pyramid[0].rgb) and torch.equal(same.pixels.x, pyramid[0].pixels.x)


def assert_channels_match_cameras(targets: Targets, least: float) -> None:
    """Values at a pixel are those of the ball's point that the level's own camera sees there."""
    channels = {name: images(targets, name) for name in (*VALUES, *WEIGHTS)}
    pixel_m = 0.45 / targets.pixels.cameras[0].intrinsics[0, 0]
    compared = 0
    for number, camera in enumerate(targets.pixels.cameras):
        assert not camera.distortion
        world, depth = world_directions(camera)
        listed = targets.pixels.index[number].numpy() >= 0
        assert (channels["mask"][number, ..., 0][listed & (depth < -2 * pixel_m)] < 0.01).all()
        safe = listed & (depth > 2 * pixel_m) & (channels["class_weight"][number, ..., 0] > 0)
        safe &= channels["normal_weight"][number, ..., 0] > 0.5
        compared += safe.sum()
        assert (channels["mask"][number, ..., 0][safe] > 0.99).all()
        np.testing.assert_allclose(channels["normals"][number][safe], world[safe], atol=0.02)
        colour = (0.3 + 0.1 * np.sin(6 * world + [0, 1, 2]))[safe]
        np.testing.assert_allclose(channels["rgb"][number][safe], colour, atol=0.015)
        # Labels, except at their borders: all neighbouring pixels have the same label.
        label = labels_of(world)
        shifted = [np.roll(label, step, axis) for axis in (0, 1) for step in (-1, 1)]
        pure = safe & np.all([s == label for s in shifted], axis=0) & (label != 3)
        names = np.array([targets.class_names.index("left_eye" if k == 4 else "skin") for k in label[pure]])
        np.testing.assert_array_equal(channels["classes"][number][pure].argmax(-1), names)
    assert compared > least


def test_landmarks_match_the_cameras_of_the_levels(pyramid, capture):
    points = small.landmarks_68()
    for targets in pyramid:
        landmarks = targets.landmarks["68"].numpy()
        assert landmarks.shape == (5, 68, 3)
        for camera, view in zip(targets.pixels.cameras, landmarks, strict=True):
            np.testing.assert_allclose(view[:, :2], camera.project(points)[0], atol=0.02)
        np.testing.assert_allclose(np.unique(landmarks[..., 2]), [0.2, 1.0], rtol=1e-6)


def test_windows_contain_the_head_and_a_margin(pyramid):
    """The ball's outline is inside every crop, pixels far from it are not; all crops have one size."""
    finest = pyramid[0]
    assert len({(c.width_px, c.height_px) for c in finest.pixels.cameras}) == 1
    assert finest.pixels.cameras[0].width_px % 2 ** (LEVELS - 1) == 0
    for camera, index in zip(finest.pixels.cameras, finest.pixels.index.numpy(), strict=True):
        assert camera.width_px < 130 and camera.height_px < 160
        # The head is what is neither hair nor neck; its outline is in the window.
        angle = np.linspace(0, 2 * np.pi, 400)
        ball = small.RADIUS_M * np.stack([np.cos(angle), np.sin(angle), 0 * angle], 1) @ camera.T_cam_world[:3, :3]
        direction = ball / small.RADIUS_M
        head = np.isin(labels_of(direction), (1, 4))
        x, y = camera.project(ball[head])[0].T
        assert x.min() > 4 and y.min() > 4 and x.max() < camera.width_px - 4 and y.max() < camera.height_px - 4
        rows, columns = index.shape
        assert (rows, columns) == (camera.height_px, camera.width_px)
    assert 55 < finest.px_per_head < 80  # the ball is 98 px high
    assert pyramid[1].px_per_head == finest.px_per_head / 2


def test_a_level_is_the_block_mean_of_the_one_before(pyramid):
    for fine, coarse in zip(pyramid, pyramid[1:], strict=False):
        for name in ("rgb", "mask", "classes"):
            before, after = images(fine, name), images(coarse, name)
            n, h, w, d = after.shape
            blocks = before.reshape(n, h, 2, w, 2, d).mean((2, 4))
            whole = (fine.pixels.index.numpy() >= 0).reshape(n, h, 2, w, 2).all((2, 4))
            whole &= coarse.pixels.index.numpy() >= 0
            assert whole.sum() > 500 / 4
            np.testing.assert_allclose(after[whole], blocks[whole], atol=2e-3)


def test_downsampling_while_decoding_gives_the_same_level(capture, pyramid):
    """At half the resolution: crops may start elsewhere, as their cameras say."""
    half = build_pyramid(capture, class_map(CLASSES), finest_head_px=43, levels=1)[0]  # of 87
    assert half.px_per_head == pytest.approx(pyramid[1].px_per_head, abs=1)
    compared = 0
    for number, camera in enumerate(half.pixels.cameras):
        other = pyramid[1].pixels.cameras[number]
        shift = other.intrinsics[:2, 2] - camera.intrinsics[:2, 2]
        np.testing.assert_allclose(camera.intrinsics[0, 0], other.intrinsics[0, 0])
        if np.abs(shift - shift.round()).max() > 1e-9:
            continue  # windows begin half a pixel apart
        dx, dy = shift.round().astype(int)
        a, b = images(pyramid[1], "rgb")[number], images(half, "rgb")[number]
        ours, theirs = pyramid[1].pixels.index[number].numpy() >= 0, half.pixels.index[number].numpy() >= 0
        y, x = np.nonzero(ours)
        inside = (y - dy >= 0) & (y - dy < b.shape[0]) & (x - dx >= 0) & (x - dx < b.shape[1])
        y, x = y[inside], x[inside]
        both = theirs[y - dy, x - dx]
        compared += both.sum()
        np.testing.assert_allclose(a[y, x][both], b[y - dy, x - dx][both], atol=2e-3)
    assert compared > 500


@pytest.mark.parametrize("level", range(LEVELS))
def test_hair_and_outlines_of_other_objects_have_no_weight(pyramid, level):
    """Hair has no weight at all. Mask weight lies on the head and on the background that is nearest to the head."""
    targets = pyramid[level]
    weights = {name: images(targets, name)[..., 0] for name in WEIGHTS}
    checked = {"hair": 0, "head": 0, "neck": 0, "beside head": 0, "beside others": 0, "far": 0}
    for number, camera in enumerate(targets.pixels.cameras):
        world, depth = world_directions(camera)
        label = np.where(depth > 0, labels_of(world), 0)
        near_outline = np.abs(depth) < 1.5 * 0.45 / camera.intrinsics[0, 0]
        borders = [np.roll(label, step, axis) != label for axis in (0, 1) for step in (-1, 1)]
        pure = ~np.any(borders, axis=0) & ~near_outline
        inner = {"hair": pure & (label == 3), "neck": pure & (label == 2), "head": pure & np.isin(label, (1, 4))}
        assert all((w[number][inner["hair"]] == 0).all() for w in weights.values())
        outline = weights["mask_weight"][number]
        margin = 0.08 * np.ptp(np.flatnonzero(np.isin(label, (1, 4)).any(1))) + 2
        to_head, to_other = (distance_transform_edt(~np.isin(label, k)) for k in ((1, 4), (2, 3)))
        background = (depth < 0) & ~near_outline
        clear = np.abs(to_head - to_other) > 2
        inner["beside head"] = background & clear & (to_head < to_other) & (to_head < margin - 1)
        inner["beside others"] = background & clear & (to_other < to_head)
        inner["far"] = background & (to_head > margin + 1)
        for name, here in inner.items():
            here = here & (targets.pixels.index[number].numpy() >= 0) if name in ("head", "neck") else here
            checked[name] += here.sum()
            assert (outline[here] == (name in ("head", "beside head"))).all(), name
        seen_neck = inner["neck"] & (targets.pixels.index[number].numpy() >= 0)
        assert (weights["class_weight"][number][seen_neck] == 1).all()
    assert min(checked.values()) > 0 or level == LEVELS - 1


def test_grazing_normals_have_less_weight(pyramid):
    targets = pyramid[0]
    for number, camera in enumerate(targets.pixels.cameras):
        weight = images(targets, "normal_weight")[number, ..., 0]
        world, depth = world_directions(camera)
        y, x = np.mgrid[: camera.height_px, : camera.width_px] + 0.5
        rays = np.stack([x, y, np.ones_like(x)], -1) @ np.linalg.inv(camera.intrinsics).T @ camera.T_cam_world[:3, :3]
        facing = -(rays * world).sum(-1) / np.linalg.norm(rays, axis=-1)
        used = weight > 0
        np.testing.assert_allclose(weight[used], facing[used], atol=0.04)
        rgb = images(targets, "rgb_weight")[number, ..., 0]
        np.testing.assert_allclose(rgb[rgb > 0], weight[rgb > 0])
        assert (rgb > 0).sum() < used.sum()  # a pixel is eroded at the outline


def test_listed_pixels_are_those_with_any_weight(pyramid):
    for targets in pyramid:
        total = sum(getattr(targets, name).float() for name in WEIGHTS)
        assert (total > 0).all()
        for name in (*VALUES, *WEIGHTS):
            assert getattr(targets, name).dtype == torch.float16
        assert targets.depth is None and targets.select([0], torch.device("cpu")).depth is None  # there are none


def test_views_may_lack_masks_normals_and_labels(tmp_path):
    parts = ("mask", "normals", "labels")
    views = [labelled_view(f"cam{i}", yaw_rad) for i, yaw_rad in enumerate(small.YAWS_RAD)]
    views = [replace(view, **({parts[i]: None} if i < 3 else {})) for i, view in enumerate(views)]
    views[3] = replace(views[3], mask=None, normals=None, labels=None, landmarks={})
    targets = build_pyramid(capture_of(tmp_path / "ball", views), class_map(CLASSES), finest_head_px=999, levels=2)[1]
    used = {name: [bool((images(targets, name)[k] > 0).any()) for k in range(5)] for name in WEIGHTS}
    assert used["rgb_weight"] == [True] * 5
    assert used["normal_weight"] == [True, False, True, False, True]
    assert used["class_weight"] == [True, True, False, False, True]
    # Without a mask, labels give the outline; with neither there is no outline.
    assert used["mask_weight"] == [True, True, True, False, True]
    assert (targets.landmarks["68"][3, :, 2] == 0).all()
    whole = targets.pixels.index[3] >= 0
    assert whole.sum() > 0.9 * 60 * 80


def test_a_capture_of_images_alone(tmp_path):
    views = [
        replace(labelled_view(f"cam{i}", yaw_rad), mask=None, normals=None, labels=None, landmarks={})
        for i, yaw_rad in enumerate(small.YAWS_RAD)
    ]
    write_capture(tmp_path / "ball", views, CaptureDescription(subject="ball", expression="neutral"))
    targets = build_pyramid(read_capture(tmp_path / "ball"), class_map(()), finest_head_px=999, levels=1)[0]
    assert targets.px_per_head == 160 and targets.landmarks == {} and targets.class_names == ("skin",)
    assert (targets.mask_weight == 0).all() and (targets.class_weight == 0).all() and (targets.rgb_weight > 0).any()


@pytest.mark.parametrize("views", [[2], [4, 0], [1, 3, 2, 0, 4]])
def test_select_equals_indexing(pyramid, views):
    targets = pyramid[1]
    batch = targets.select(views, torch.device("cpu"))
    assert batch.names == tuple(targets.names[v] for v in views)
    assert batch.pixels.cameras == tuple(targets.pixels.cameras[v] for v in views)
    for name in (*VALUES, *WEIGHTS):
        assert getattr(batch, name).dtype == torch.float32
        np.testing.assert_array_equal(images(batch, name), images(targets, name)[views])
    torch.testing.assert_close(batch.landmarks["68"], targets.landmarks["68"][views])
    pixels = batch.pixels
    inverse = pixels.index[pixels.view.long(), pixels.y.long(), pixels.x.long()]
    torch.testing.assert_close(inverse, torch.arange(len(pixels.view), dtype=torch.int32))
    assert (pixels.index >= 0).sum() == len(pixels.view)


def test_progress_is_reported(capture):
    done = []
    build_pyramid(capture, class_map(CLASSES), finest_head_px=40, levels=1, progress=done.append)
    assert done == [0, 1, 2, 3, 4]


def test_a_mask_larger_than_the_labels_does_not_count_the_neck_as_head(tmp_path):
    """Labels and masks come from two networks: pixels in the mask without a label belong to the neighbouring class."""
    plain = [labelled_view(f"cam{i}", yaw_rad) for i, yaw_rad in enumerate(small.YAWS_RAD)]
    larger = [replace(view, mask=distance_transform_edt(~view.mask) <= 3) for view in plain]
    finest = []
    for name, views in (("plain", plain), ("larger", larger)):
        capture = capture_of(tmp_path / name, views)
        finest.append(build_pyramid(capture, class_map(CLASSES), finest_head_px=10_000, levels=1)[0])
    tight, wide = finest
    assert wide.px_per_head == pytest.approx(tight.px_per_head, abs=6.0)  # not by the neck's length
    unlabelled = 0
    for number, (camera, view) in enumerate(zip(wide.pixels.cameras, larger, strict=True)):
        shift = np.round(view.camera.intrinsics[:2, 2] - camera.intrinsics[:2, 2]).astype(int)
        listed = np.argwhere(wide.pixels.index[number].numpy() >= 0)
        y, x = (listed + shift[::-1]).T
        held = (y < view.camera.height_px) & (x < view.camera.width_px)
        listed, y, x = listed[held], y[held], x[held]
        ring = view.mask[y, x] & (view.labels[y, x] == 0)
        distance_px = {
            name: distance_transform_edt(~np.isin(view.labels, labels))[y, x]
            for name, labels in (("head", (1, 4)), ("other", (2, 3)))
        }
        of_neck = ring & (distance_px["other"] < distance_px["head"] - 1)
        of_head = ring & (distance_px["head"] < distance_px["other"] - 1)
        weight = images(wide, "mask_weight")[number, ..., 0][tuple(listed.T)]
        classes = images(wide, "class_weight")[number, ..., 0][tuple(listed.T)]
        assert not weight[of_neck].any() and (weight[of_head] == 1).all() and not classes[ring].any()
        unlabelled += of_head.sum()
    assert unlabelled > 100


def test_a_surface_stands_in_for_missing_normal_maps(capture, pyramid):
    """Its normals are those of the maps where it is seen well; at a hole there are none, but colours count."""
    ball = small.ball()
    from_front = np.linalg.norm(ball.vertices[ball.triangles].mean(1) - [0, 0, small.RADIUS_M], axis=1)
    triangles = ball.triangles[from_front > 0.02]  # with a hole
    without = replace(capture, views=tuple(replace(view, normals=None) for view in capture.views))
    surface = SurfaceViews(ball.vertices, triangles, [view.camera for view in capture.views])
    settings = {"finest_head_px": 10_000, "levels": LEVELS, "surface": surface}
    found = build_pyramid(without, class_map(CLASSES), **settings)[0]
    normals, weights = images(found, "normals"), images(found, "normal_weight")[..., 0]
    expected, known = images(pyramid[0], "normals"), images(pyramid[0], "normal_weight")[..., 0]
    colours, bare = images(found, "rgb_weight")[..., 0], 0
    for number, camera in enumerate(found.pixels.cameras):
        world, depth = world_directions(camera)
        hole = np.linalg.norm(world * small.RADIUS_M - [0, 0, small.RADIUS_M], axis=-1) < 0.018
        inside = (depth > 0) & (known[number] > 0)
        assert not weights[number][hole].any()
        bare += (hole & inside & (colours[number] > 0)).sum()
        both = inside & (weights[number] > 0)
        assert both.sum() > 0.5 * inside.sum()
        np.testing.assert_allclose(normals[number][both], expected[number][both], atol=0.05)
        np.testing.assert_allclose(weights[number][both], known[number][both], atol=0.05)
    assert bare > 50
    for mine, theirs in zip(build_pyramid(capture, class_map(CLASSES), **settings), pyramid, strict=True):
        assert torch.equal(mine.normals, theirs.normals) and torch.equal(mine.rgb_weight, theirs.rgb_weight)


def test_spread_of_landmarks_shrinks_with_the_pixels(tmp_path) -> None:
    yaws = small.YAWS_RAD[:3]
    views = [labelled_view(f"cam{i}", yaw_rad) for i, yaw_rad in enumerate(yaws)]
    spread = np.linspace(1, 2, 68)
    views = [views[0], *(replace(view, landmark_spread_px={"68": spread}) for view in views[1:])]
    levels = build_pyramid(capture_of(tmp_path / "ball", views), class_map(CLASSES), finest_head_px=25, levels=2)
    given, found = (np.linalg.det(v.intrinsics) for v in (views[0].camera, levels[0].pixels.cameras[0]))
    shrunk = np.sqrt(given / found)  # across and down differ by rounding to whole pixels
    assert shrunk > 1
    for level in levels:
        assert level.landmark_spread_px["68"][0].isnan().all()
        np.testing.assert_allclose(level.landmark_spread_px["68"][1:], [spread / shrunk] * 2, rtol=1e-5)
        shrunk *= 2
    batch = levels[0].select([2, 0], torch.device("cpu"))
    first = batch.landmark_spread_px["68"][0, 0]  # `shrunk` was doubled for each of the two levels
    assert first == pytest.approx(4 * spread[0] / shrunk) and batch.landmarks["68"].shape[0] == 2


def test_depths_at_every_level_and_their_holes(tmp_path):
    """Those of the ball at each level's own pixels; confidences scale normals, and colours count beside holes."""
    views = []
    for i, yaw_rad in enumerate(small.YAWS_RAD):
        view = labelled_view(f"cam{i}", yaw_rad)
        world, _ = world_directions(view.camera)
        along = (small.RADIUS_M * world) @ view.camera.T_cam_world[2, :3] + view.camera.T_cam_world[2, 3]
        depth = np.where(view.mask, along, 0)
        depth[60:90, 50:70] = 0
        confidence = np.full(depth.shape, 0.4)
        normals = np.where(depth[..., None] > 0, view.normals, 0)
        views.append(replace(view, depth=depth, confidence=confidence, normals=normals))
    views[-1] = labelled_view("cam4", small.YAWS_RAD[-1])
    levels = build_pyramid(
        capture_of(tmp_path / "ball", views), class_map(CLASSES), finest_head_px=10_000, levels=LEVELS
    )
    for number, targets in enumerate(levels):
        assert targets.depth is not None and targets.depth.dtype == torch.float32
        depth, weight = images(targets, "depth")[..., 0], images(targets, "normal_weight")[..., 0]
        colour = images(targets, "rgb_weight")[..., 0]
        for view, camera in enumerate(targets.pixels.cameras[:4]):
            world, inside = world_directions(camera)
            expected = (small.RADIUS_M * world) @ camera.T_cam_world[2, :3] + camera.T_cam_world[2, 3]
            pixel_m = 0.45 / camera.intrinsics[0, 0]
            known = (depth[view] > 0) & (weight[view] > 0.2) & (inside > 2 * pixel_m)
            assert known.sum() > 1500 / 4**number
            bend = pixel_m**2 / small.RADIUS_M  # of the surface within a pixel
            assert np.median(np.abs(depth[view] - expected)[known]) < 1e-5 + bend
            # beside a hole the mean is that of the remaining pixels
            assert (np.abs(depth[view] - expected)[known] < 1e-5 + 8 * bend + 0.5 * pixel_m).all()
            facing = weight[view][known] / 0.4
            assert facing.max() <= 1.001 and facing.max() > 0.95
            hole = (depth[view] == 0) & (inside > 4 * pixel_m) & (colour[view] > 0)
            assert hole.sum() > 100 / 4**number
        assert not depth[4].any()
