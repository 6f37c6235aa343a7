from shutil import copytree

import cv2
import numpy as np
import pytest

from registration.capture.colmap import read_cameras
from registration.capture.native import read_capture
from registration.capture.native_writer import CaptureDescription, ViewArrays, write_capture
from registration.capture.pixels import read_view
from registration.capture.scan import read_scan
from registration.errors import InputError
from registration.stereo.backends import load_backend
from registration.stereo.fuse import fuse
from registration.stereo.head_position import find_head
from registration.stereo.of_capture import capture_depths, read_photographs, write_depths
from registration.stereo.patch_match import write_workspace
from registration.stereo.second_pass import refined_depths, sharpened_depths
from registration.stereo.views import head_image
from tests.registration.stereo.scene import CENTRE, RADIUS, errors, scene


@pytest.fixture(scope="module")
def made():
    return scene((-22, 0, 22))


@pytest.fixture(scope="module")
def capture(made, tmp_path_factory):
    views = []
    for number, (view, seen) in enumerate(zip(made.views, made.truth, strict=True)):
        rgb = np.repeat(np.round(255 * view.image).astype(np.uint8)[..., None], 3, -1)
        views.append(ViewArrays(name=f"cam{number}", camera=view.camera, rgb=rgb, mask=seen.face >= 0))
    description = CaptureDescription(subject="egg", expression="neutral")
    return read_capture(write_capture(tmp_path_factory.mktemp("egg") / "capture", views, description))


def test_masks_tell_where_the_head_is(capture):
    head = find_head(capture)
    assert np.linalg.norm(head.centre - CENTRE) < 0.03
    assert 0.1 < head.radius_m < 0.2


def test_a_capture_gets_depths_normals_and_a_cloud(made, capture, tmp_path):
    head = find_head(capture)
    views = read_photographs(capture, head)
    found = capture_depths(capture, views, head)
    assert found.warnings == ()
    out = tmp_path / "out"
    write_depths(found, capture, views, out)
    assert {path.name for path in out.iterdir()} == {"normals", "depth", "confidence", "scan.ply", "stereo.png"}
    assert cv2.imread(str(out / "stereo.png")).shape[1] > 900
    cloud = read_scan(out / "scan.ply")
    assert len(cloud.vertices) > 3000
    copied = copytree(capture.root, tmp_path / "copy")
    for folder in ("normals", "depth", "confidence"):
        copytree(out / folder, copied / folder)
    again = read_capture(copied)
    read = read_view(again.views[1], again)
    shown = (made.truth[1].weight > 0.4) & (read.depth > 0)
    assert shown.sum() > 0.5 * (made.truth[1].weight > 0.4).sum()
    assert np.median(np.abs(read.depth - made.truth[1].depth)[shown]) < 3e-4
    with pytest.raises(InputError):
        write_depths(found, capture, views, out)


def test_photographs_without_texture_are_warned_about(capture):
    flat = scene((-22, 0, 22), contrast=0.0)
    found = capture_depths(capture, flat.views, find_head(capture))
    assert any("texture" in warning for warning in found.warnings)


def test_the_first_passes_own_depths_are_refined(made):
    first = load_backend("sgbm").depths(made.views, CENTRE, RADIUS)
    second = sharpened_depths(made.views, first, CENTRE)
    before = errors(first[1], made.views[1].camera, made.truth[1])
    after = errors(second[1], made.views[1].camera, made.truth[1])
    assert after[0] > 0.9 * before[0]
    assert np.median(after[1]) < 0.8 * np.median(before[1])


def test_the_cloud_lies_on_the_surface_and_faces_outwards(made):
    cloud = fuse(refined_depths(made.views, made.vertices, made.triangles))
    assert len(cloud.points) > 3000
    assert ((cloud.points - CENTRE) * cloud.normals).sum(1).min() > 0
    np.testing.assert_allclose(np.linalg.norm(cloud.normals, axis=1), 1, atol=1e-6)


def test_colmaps_stereo_is_refused_without_a_gpu(made):
    pycolmap = pytest.importorskip("pycolmap", reason="pycolmap is not installed: make setup-optional")
    if pycolmap.has_cuda:
        pytest.skip("this pycolmap has CUDA")
    with pytest.raises(InputError, match="cannot run here") as refused:
        load_backend("colmap").depths(made.views, CENTRE, RADIUS)
    assert "colmap-cuda" in refused.value.fix


def test_an_unknown_backend_is_refused():
    with pytest.raises(InputError, match="no such stereo backend"):
        load_backend("magic")


def test_colmaps_workspace_names_partners_and_cameras(made, tmp_path):
    images = [head_image(view, CENTRE, RADIUS) for view in made.views]
    write_workspace(tmp_path, images, ((1,), (0, 2), ()))
    lines = (tmp_path / "stereo" / "patch-match.cfg").read_text().splitlines()
    assert lines == ["0000.png", "0001.png", "0001.png", "0000.png, 0002.png"]
    cameras = read_cameras(tmp_path / "sparse")
    np.testing.assert_allclose(cameras["0002.png"].intrinsics, images[2].camera.intrinsics, atol=1e-9)
    assert cv2.imread(str(tmp_path / "images" / "0001.png")).shape[:2] == images[1].grey.shape
