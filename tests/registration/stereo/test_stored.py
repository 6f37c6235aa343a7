"""Maps on stored photographs, with distortion, read again as any capture's channels are."""

from dataclasses import replace

import numpy as np
import pytest

from registration.capture.native import read_capture
from registration.capture.native_writer import CaptureDescription, ViewArrays, write_capture, write_channels
from registration.capture.pixels import read_view
from registration.stereo.depth_map import DepthMap
from registration.stereo.local_planes import fit_planes
from registration.stereo.stored import stored_maps
from registration.stereo.views import StereoView, camera_image, head_image, rays
from tests.registration.stereo.scene import CENTRE, RADIUS, camera, scene


@pytest.mark.parametrize("distortion", [(), (-0.18, 0.1, 1e-3, -2e-3)])
def test_maps_come_back_from_the_stored_grid(tmp_path, distortion):
    stored = replace(camera(12, size=240), distortion=distortion)
    view = StereoView(image=np.zeros((240, 240), np.float32), camera=camera(12, size=240))
    window = head_image(view, CENTRE, RADIUS, 200).camera  # reduced
    ray = rays(window)
    normal = np.array([0.2, -0.1, -1.0], np.float32) / np.sqrt(1.05)  # a tilted plane through the head's centre
    distance = float(normal @ (window.T_cam_world[:3, :3] @ CENTRE + window.T_cam_world[:3, 3]))
    depth = (distance / (ray @ normal)).astype(np.float32)
    depth[:20] = 0  # without depths
    known = (depth > 0).astype(np.float32)
    normals = np.where(known[..., None] > 0, normal, 0).astype(np.float32)
    made = DepthMap(camera=window, depth=depth, normals=normals, confidence=0.6 * known)
    arrays = stored_maps("cam0", stored, made)
    root = write_capture(
        tmp_path / "capture",
        [ViewArrays(name="cam0", camera=stored, rgb=np.zeros((240, 240, 3), np.uint8))],
        CaptureDescription(subject="plane", expression="neutral"),
    )
    write_channels(root, arrays)
    capture = read_capture(root)
    read = read_view(capture.views[0], capture)
    expected = distance / (rays(read.camera) @ normal)
    held = read.depth > 0
    assert 0.5 < held.mean() < 0.95
    assert np.abs(read.depth - expected)[held].max() < 2e-4
    assert np.degrees(np.arccos(np.clip(read.normals[held] @ normal, -1, 1))).max() < 0.2
    assert np.abs(np.median(read.confidence[held]) - 0.6) < 0.01
    assert read.confidence[held].max() < 0.61  # beside missing depths it is lower


def test_windows_are_found_again():
    view = scene((5,)).views[0]
    for most in (720, 150):
        window = head_image(view, CENTRE, 0.8 * RADIUS, most)
        again = camera_image(view, window.camera)
        np.testing.assert_array_equal(again.grey, window.grey)
        np.testing.assert_allclose(again.camera.intrinsics, window.camera.intrinsics)


def test_planes_are_met_exactly_across_holes():
    ray = rays(camera(0))
    normal = np.array([0.5, 0.3, -1.0], np.float32)
    normal /= np.linalg.norm(normal)
    depth = (-1.0 / (ray @ normal)).astype(np.float32)
    holes = np.random.default_rng(0).random(depth.shape) < 0.4
    smooth, normals = fit_planes(np.where(holes, 0, depth), np.ones_like(depth), ray, 2.0)
    middle = np.s_[10:-10, 10:-10]
    assert np.abs(smooth / depth - 1)[middle].max() < 1e-4
    assert np.degrees(np.arccos(np.clip(normals[middle] @ normal, -1, 1))).max() < 0.2
