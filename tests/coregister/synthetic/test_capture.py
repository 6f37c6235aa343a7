"""Synthetic captures, read back and compared with the mesh that they were rendered from."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from coregister.synthetic.capture import LABELS, Studio, render_capture
from registration.capture import native, triangulation
from registration.capture.pixels import read_image, read_labels, read_mask, read_normals
from registration.capture.scan import read_scan, read_truth
from registration.doctor.report import check_capture
from registration.errors import InputError
from registration.geometry.closest_point import closest_points
from registration.geometry.rasterizer import visible
from registration.geometry.topology import vertex_normals
from registration.model import gnm_npz
from registration.model.gnm_numpy import evaluate
from registration.model.landmarks import read_scheme
from registration.model.regions import exterior, group, vertex_classes
from registration.render.studio.shoot import Quality, Sensor
from tests.conftest import FIXTURES

TINY = gnm_npz.read(FIXTURES / "tiny_gnm.npz")
SCHEMES = {"68": read_scheme(FIXTURES / "head_sparse_68.txt", TINY.template_vertex_positions)}
SMALL = Studio(
    cameras=6,
    size_px=(144, 216),
    spread_deg=(110.0, 40.0),
    texture_size=256,
    quality=Quality(pixel_samples=2, light_rays=32, subdivisions=1),
)
WORN = replace(SMALL, hair=True, shirt=True)


def vertices() -> np.ndarray:
    """Another identity and expression than the template's, in a rotated world."""
    return evaluate(
        TINY,
        identity=np.array([0.4, -0.8, 0.7, 0.5, -0.6, 0.9]),
        expression=np.array([0.5, 0.4, 0.3, 0.5, 0.0, 0.0, 0.0]),
        rotations=np.array([[0.5, -0.8, 0.3], [0.04, 0.1, -0.03], [0, 0, 0], [0, 0, 0]]),
        translation=np.array([0.7, -0.3, 1.1]),
    )


def make(root: Path, studio: Studio) -> Path:
    return render_capture(
        root,
        data=TINY,
        vertices=vertices(),
        schemes=SCHEMES,
        subject="tiny",
        expression="smile",
        tags={"age": 30, "category": "synthetic"},
        studio=studio,
    )


@pytest.fixture(scope="module", params=[False, True], ids=["pinhole", "lens"])
def capture(request, tmp_path_factory):
    root = make(tmp_path_factory.mktemp("synth") / "tiny", replace(SMALL, distortion=request.param))
    return native.read_capture(root)


@pytest.fixture(scope="module")
def worn(tmp_path_factory):
    return native.read_capture(make(tmp_path_factory.mktemp("synth") / "worn", WORN))


def pixels_of(camera, points: np.ndarray) -> np.ndarray:
    """World points in the distorted image, by OpenCV."""
    rotation = cv2.Rodrigues(camera.T_cam_world[:3, :3])[0]
    lens = np.array(camera.distortion or (0.0,) * 4)
    return cv2.projectPoints(points, rotation, camera.T_cam_world[:3, 3], camera.intrinsics, lens)[0][:, 0]


def at(image: np.ndarray, xy: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The pixels that hold positions, and which positions are inside."""
    height, width = image.shape[:2]
    inside = (xy >= 0).all(1) & (xy < (width, height)).all(1)
    x, y = xy[inside].astype(int).T
    return image[y, x], inside


def test_the_capture_check_reports_no_problem(capture) -> None:
    report = check_capture(capture.root)
    assert report.warnings == ()
    assert (capture.subject, capture.expression, capture.tags["age"]) == ("tiny", "smile", 30)
    assert capture.classes == LABELS and len(capture.views) == SMALL.cameras
    assert all(row.normals and row.labels and row.coverage > 0.2 for row in report.views)
    np.testing.assert_allclose(read_truth(capture.ground_truth), vertices())


def test_a_capture_with_hair_and_shirt_passes_too(worn) -> None:
    assert check_capture(worn.root).warnings == ()


def test_the_scan_lies_in_the_masks(capture) -> None:
    points = read_scan(capture.scan).vertices
    for view in capture.views:
        value, inside = at(read_mask(view.mask, view.camera), pixels_of(view.camera, points))
        assert inside.mean() > 0.9 and (value > 0).mean() >= 0.98


def test_the_scan_is_the_heads_visible_outside(capture) -> None:
    scan = read_scan(capture.scan)
    face = on_the_head(scan.vertices)
    assert len(np.unique(scan.triangles)) == len(scan.vertices) > 1.5 * exterior(TINY).sum()
    inner = (group(TINY, "teeth") + group(TINY, "tongue") + group(TINY, "gums"))[TINY.triangles].max(1) > 0.5
    assert not inner[face].any()
    a, b, c = scan.vertices[scan.triangles].transpose(1, 0, 2)
    normals, centres = np.cross(b - a, c - a), (a + b + c) / 3
    views = np.stack([((view.camera.centre - centres) * normals).sum(1) > 0 for view in capture.views])
    assert views.any(0).mean() > 0.99


def test_labels_equal_the_vertices_classes(capture) -> None:
    truth, (names, memberships) = vertices(), vertex_classes(TINY)
    pure = np.ones(len(truth), bool)  # vertices whose neighbours all have their class
    vertex_class = memberships.argmax(1)
    for a, b in ((0, 1), (1, 2), (2, 0)):
        differ = vertex_class[TINY.triangles[:, a]] != vertex_class[TINY.triangles[:, b]]
        pure[TINY.triangles[differ].ravel()] = False
    seen_classes = set()
    for view in capture.views:
        labels = read_labels(view.segmentation, view.camera, capture.classes)
        chosen = np.flatnonzero(pure & visible(truth, truth, TINY.triangles, view.camera, 1e-3))
        # Not at silhouettes, where a pixel's centre may miss what its corner shows.
        normal = facing(truth, view.camera)
        chosen = chosen[normal[chosen] > 0.3]
        value, inside = at(labels, pixels_of(view.camera, truth[chosen]))
        expected = np.array([LABELS.index(names[k]) for k in vertex_class[chosen[inside]]])
        value = np.where(value == LABELS.index("neck_other"), LABELS.index("skin"), value)
        assert len(value) > 100 and (value == expected).mean() > 0.93
        # A pixel is 2 mm: next to the outline of an eye or ear, labels may be off by one pixel, but not more.
        xy = pixels_of(view.camera, truth[chosen[inside]])
        merged = np.where(labels == LABELS.index("neck_other"), LABELS.index("skin"), labels)
        around = [at(np.pad(merged, 1), xy + (1 + x, 1 + y))[0] for x in (-1, 0, 1) for y in (-1, 0, 1)]
        assert (np.stack(around) == expected).any(0).mean() > 0.99
        seen_classes |= set(np.unique(value).tolist())
    assert {LABELS.index(name) for name in ("skin", "left_eye", "right_eye", "ears")} <= seen_classes


def on_the_head(points: np.ndarray) -> np.ndarray:
    """The face of the head that each point lies on; fails for points that lie on none."""
    distance, face, _ = closest_points(points, vertices(), TINY.triangles)
    assert distance.max() < 1e-6
    return face


def facing(points: np.ndarray, camera) -> np.ndarray:
    """Cosine between each vertex' normal and the direction to the camera."""
    normals = vertex_normals(torch.as_tensor(points), torch.as_tensor(TINY.triangles.astype(np.int64))).numpy()
    to_camera = camera.centre - points
    return (normals * to_camera).sum(1) / np.linalg.norm(to_camera, axis=1)


def test_left_is_the_subjects_left(capture) -> None:
    front = min(
        capture.views, key=lambda view: -facing(vertices(), view.camera)[group(TINY, "hockey_mask") > 0.5].mean()
    )
    labels = read_labels(front.segmentation, front.camera, capture.classes)
    columns = [np.nonzero(labels == LABELS.index(f"{side}_eye"))[1].mean() for side in ("left", "right")]
    assert columns[0] > columns[1] + 5


def test_normals_face_the_camera_and_follow_the_mesh(capture) -> None:
    truth = vertices()
    for view in capture.views:
        raw = read_normals(view.normals, view.camera)
        normals = raw / 65535 * 2 - 1
        hit = raw.any(-1)
        assert np.abs(np.linalg.norm(normals[hit], axis=1) - 1).max() < 1e-4
        labels = read_labels(view.segmentation, view.camera, capture.classes)
        assert ((labels > 0) == hit).all()
        chosen = np.flatnonzero(
            visible(truth, truth, TINY.triangles, view.camera, 1e-3) & (facing(truth, view.camera) > 0.5)
        )
        value, _ = at(normals, pixels_of(view.camera, truth[chosen]))
        world = vertex_normals(torch.as_tensor(truth), torch.as_tensor(TINY.triangles.astype(np.int64))).numpy()
        expected = world[chosen] @ view.camera.T_cam_world[:3, :3].T
        # A pixel is 2 mm here, and triangles are 12 mm: half a pixel rotates the normal by degrees.
        assert np.median(np.degrees(np.arccos(np.clip((value * expected).sum(1), -1, 1)))) < 5


def test_landmarks_match_the_mesh(capture) -> None:
    points, used, residuals = triangulation.triangulate(capture, "68")
    truth = SCHEMES["68"].points(vertices())
    assert (used >= 2).all()
    assert np.linalg.norm(points - truth, axis=1).max() < 1e-4 and residuals.max() < 0.01
    for view in capture.views:
        marks = view.landmarks["68"]
        np.testing.assert_allclose(marks[:, :2], pixels_of(view.camera, truth), atol=1e-6)
        agree = (marks[:, 2] > 0.5) == visible(truth, vertices(), TINY.triangles, view.camera, 2e-3)
        assert set(np.unique(marks[:, 2])) <= {1.0, 0.2} and agree.mean() > 0.95


def test_hair_and_shirt_are_visible_and_do_not_cover_the_face(capture, worn) -> None:
    if capture.views[0].camera.distortion:
        pytest.skip("the worn capture's cameras have no lenses")
    truth = vertices()
    face = np.flatnonzero(group(TINY, "hockey_mask") > 0.5)
    for bare, view in zip(capture.views, worn.views, strict=True):
        np.testing.assert_array_equal(bare.camera.T_cam_world, view.camera.T_cam_world)
        before = read_labels(bare.segmentation, bare.camera, capture.classes)
        labels = read_labels(view.segmentation, view.camera, worn.classes)
        assert not np.isin(before, [LABELS.index("hair"), LABELS.index("clothes")]).any()
        assert (labels == LABELS.index("hair")).mean() > 0.02 and (labels == LABELS.index("clothes")).mean() > 0.02
        visible_rows = face[
            visible(truth[face], truth, TINY.triangles, view.camera, 1e-3) & (facing(truth, view.camera)[face] > 0.2)
        ]
        value, _ = at(labels, pixels_of(view.camera, truth[visible_rows]))
        assert np.isin(value, [LABELS.index("hair"), LABELS.index("clothes")]).mean() < 0.02
        hidden = (before > 0) & np.isin(labels, [LABELS.index("hair"), LABELS.index("clothes")])
        assert not np.isin(before[hidden], [LABELS.index(f"{side}_eye") for side in ("left", "right")]).any()


def test_the_scan_excludes_skin_under_hair_and_shirt(capture, worn) -> None:
    bare, scan = read_scan(capture.scan), read_scan(worn.scan)
    assert len(scan.vertices) < 0.9 * len(bare.vertices)
    on_the_head(scan.vertices)


def test_equal_settings_give_equal_captures(tmp_path) -> None:
    noisy = replace(SMALL, cameras=2, size_px=(72, 96), sensor=Sensor(read_noise=0.01, exposure_spread=0.1))
    roots = [
        make(tmp_path / name, studio) for name, studio in (("a", noisy), ("b", noisy), ("c", replace(noisy, seed=1)))
    ]
    files = sorted(path.relative_to(roots[0]) for path in roots[0].rglob("*") if path.is_file())
    assert len(files) > 10
    for file in files:
        assert (roots[0] / file).read_bytes() == (roots[1] / file).read_bytes(), file
    assert (roots[0] / "images/cam00.png").read_bytes() != (roots[2] / "images/cam00.png").read_bytes()


def test_images_of_sixteen_bits(tmp_path) -> None:
    capture = native.read_capture(make(tmp_path / "deep", replace(SMALL, cameras=2, size_px=(48, 64), bits=16)))
    assert read_image(capture.views[0].image, capture.views[0].camera).dtype == np.uint16


@pytest.mark.parametrize(
    "change",
    [
        {"cameras": 0},
        {"size_px": (0, 10)},
        {"size_px": (9000, 10)},
        {"size_px": (8000, 8000)},
        {"texture_size": 8},
        {"bits": 12},
        {"quality": Quality(pixel_samples=0)},
        {"quality": Quality(light_rays=0)},
    ],
)
def test_invalid_studio_options_are_refused(tmp_path, change) -> None:
    with pytest.raises(InputError):
        make(tmp_path / "refused", replace(SMALL, **change))
    assert list(tmp_path.iterdir()) == []


def test_vertices_of_another_topology_are_refused(tmp_path) -> None:
    broken = vertices()
    broken[3, 1] = np.nan
    for wrong in (vertices()[:-1], broken):
        with pytest.raises(InputError, match="vertices"):
            render_capture(
                tmp_path / "x", data=TINY, vertices=wrong, schemes={}, subject="s", expression="e", studio=SMALL
            )


def test_an_existing_folder_is_not_overwritten(tmp_path) -> None:
    (tmp_path / "mine").mkdir()
    with pytest.raises(InputError, match="exists"):
        make(tmp_path / "mine", SMALL)
    assert list((tmp_path / "mine").iterdir()) == []
