"""Differences between a capture and its degraded copy, measured on the files."""

import shutil
import tomllib
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from registration.capture import native
from registration.capture.native_writer import CaptureDescription, write_capture
from registration.capture.scan import read_scan
from registration.degrading.degradation import PRESETS, DegradationPreset
from registration.degrading.degrade import degrade
from registration.doctor.report import check_capture
from registration.errors import InputError
from registration.types import Capture, View
from tests.conftest import SHARED, needs_shared
from tests.registration.capture import small
from tests.registration.capture.small import CLASSES, DISTORTIONS, ball, camera, landmarks_68, make

YAWS_RAD = (-1.2, -0.8, -0.3, 0.1, 0.4, 0.8, 1.1)
MANY = 1000  # landmarks of a second scheme, for statistics
FOLDERS = ("images", "masks", "normals", "segmentation", "landmarks")


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Seven views of the ball, 240 x 320, each with its own distortion; two in a subfolder."""
    sphere = np.random.default_rng(0).standard_normal((MANY, 3))
    sphere *= 0.09 / np.linalg.norm(sphere, axis=-1, keepdims=True)
    views = []
    for number, yaw_rad in enumerate(YAWS_RAD):
        lens = DISTORTIONS["OPENCV"] if number == 2 else ()
        cam = camera(yaw_rad, distortion=lens, width_px=240, height_px=320)
        view = small.synthetic_view(f"left/cam{number}" if number < 2 else f"cam{number}", cam)
        many = np.column_stack([small.distorted(cam, sphere), np.where(np.arange(MANY) % 2, 1.0, 0.2)])
        views.append(replace(view, landmarks={**view.landmarks, "many": many}))
    root = tmp_path_factory.mktemp("source") / "capture"
    tags = {"age": 30, "notes": 'with "quotes"'}
    scan, truth = ball(), landmarks_68()
    description = CaptureDescription(subject="ball", expression="e", classes=CLASSES, tags=tags)
    write_capture(root, views, description, points=truth, scan=scan, truth=truth)
    return root


@pytest.fixture(scope="module", params=["studio", "harsh"])
def degraded(request: pytest.FixtureRequest, source: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return degrade(source, tmp_path_factory.mktemp(request.param) / "capture", preset=PRESETS[request.param], seed=5)


def preset_factor(root: Path) -> int:
    """The copy's expected errors as a multiple of the preset "studio"."""
    return 2 if "preset harsh" in native.read_capture(root).tags["spoiled"] else 1


def pairs(source: Path, target: Path) -> list[tuple[View, View]]:
    before = {view.name: view for view in native.read_capture(source).views}
    return [(before[view.name], view) for view in native.read_capture(target).views]


def load(path: Path | None) -> np.ndarray:
    """Pixels in the file's bit depth, BGR or gray."""
    pixels = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    assert pixels is not None
    return pixels


def linear(path: Path) -> np.ndarray:
    pixels = load(path)
    value = pixels / np.iinfo(pixels.dtype).max
    return np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)


def unit_normals(path: Path | None) -> np.ndarray:
    return load(path)[..., ::-1].astype(np.float64) * 2 / 65535 - 1


def files(root: Path) -> dict[str, bytes]:
    return {str(path.relative_to(root)): path.read_bytes() for path in sorted(root.rglob("*")) if path.is_file()}


def boundary_band(regions: np.ndarray, radius_px: int) -> np.ndarray:
    """Pixels within about this distance of where a map of indices changes."""
    size = 2 * radius_px + 1
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size))
    return cv2.dilate(regions, disc) != cv2.erode(regions, disc)


def test_camera_errors_equal_those_of_the_preset(source: Path, degraded: Path) -> None:
    points = read_scan(source / "scan.ply").vertices
    angles, distances, zooms = [], [], []
    for before, after in pairs(source, degraded):
        old, new = before.camera, after.camera
        plain = [small.distorted(replace(cam, distortion=()), points) for cam in (old, new)]
        error_px = np.sqrt(((plain[1] - plain[0]) ** 2).sum(-1).mean())
        assert error_px == pytest.approx(0.3 * preset_factor(degraded), rel=0.03)
        assert new.distortion == pytest.approx(old.distortion)
        assert (new.width_px, new.height_px) == (old.width_px, old.height_px)
        np.testing.assert_array_equal(new.intrinsics[:2, 2], old.intrinsics[:2, 2])
        zoom = new.intrinsics[[0, 1], [0, 1]] / old.intrinsics[[0, 1], [0, 1]]
        assert zoom[0] == pytest.approx(zoom[1])
        relative = new.T_cam_world[:3, :3] @ old.T_cam_world[:3, :3].T
        angles.append(np.arccos(np.clip((np.trace(relative) - 1) / 2, -1, 1)))
        distances.append(np.linalg.norm(new.centre - old.centre))
        zooms.append(zoom[0] - 1)
    # A pixel at this focal length is 2 mrad or 0.9 mm; a zoom of 1 % moves the ball's outline by less than a pixel.
    assert 1e-5 < min(angles) and max(angles) < 5e-3
    assert 1e-6 < min(distances) and max(distances) < 3e-3
    assert 1e-6 < np.abs(zooms).max() < 1e-2 and np.std(zooms) > 1e-6


def test_without_a_scan_landmarks_give_the_position_of_the_subject(tmp_path: Path) -> None:
    bare = make(tmp_path / "bare")
    (bare / "scan.ply").unlink()
    degrade(bare, tmp_path / "out", preset=DegradationPreset(name="cameras", camera_rms_px=1.0))
    for before, after in pairs(bare, tmp_path / "out"):
        displacement_px = after.camera.project(landmarks_68())[0] - before.camera.project(landmarks_68())[0]
        assert np.sqrt((displacement_px**2).sum(-1).mean()) == pytest.approx(1.0, rel=0.02)


def test_normals_have_smooth_rotations_and_outliers(source: Path, degraded: Path) -> None:
    factor = preset_factor(degraded)
    correlation_px = 8 * factor
    squares, wrong, count, products = 0.0, 0, 0, {lag: [] for lag in (1, correlation_px, 3 * correlation_px)}
    for before, after in pairs(source, degraded):
        if after.normals is None:
            continue
        assert load(after.normals).dtype == np.uint16
        old, new = unit_normals(before.normals), unit_normals(after.normals)
        subject = load(before.normals).any(-1)
        np.testing.assert_array_equal(load(after.normals).any(-1), subject)
        assert np.abs(np.linalg.norm(new[subject], axis=-1) - 1).max() < 1e-3
        angle = np.degrees(np.arctan2(np.linalg.norm(np.cross(old, new), axis=-1), (old * new).sum(-1)))
        # In a Rayleigh distribution a fraction of 1e-4 exceeds three times the rms.
        good = subject & (angle < 15 * factor)
        wrong += (subject & ~good).sum()
        assert new[subject & ~good][:, 2].max() < 0  # towards the camera
        count += subject.sum()
        squares += (angle[good] ** 2).sum()
        error = new - old
        for lag, covariances in products.items():
            both_good = good[:, lag:] & good[:, :-lag]
            covariances.append((error[:, lag:] * error[:, :-lag]).sum(-1)[both_good].mean())
    variance = squares / count * np.radians(1) ** 2
    assert np.sqrt(squares / count) == pytest.approx(5 * factor, rel=0.08)
    # A random direction towards the camera is within the limit by chance in 1 of 30 cases (at 30 degrees 1 of 8).
    assert 0.75 * 0.02 * factor < wrong / count < 0.02 * factor
    near, middle, far = (np.mean(covariances) / variance for covariances in products.values())
    assert near > 0.93 and 0.22 < middle < 0.48 and abs(far) < 0.12


def test_landmarks_have_noise_and_confident_outliers(source: Path, degraded: Path) -> None:
    factor = preset_factor(degraded)
    displacements = []
    for before, after in pairs(source, degraded):
        assert set(after.landmarks) == {"68", "many"}
        for scheme, points in after.landmarks.items():
            np.testing.assert_array_equal(points[:, 2], before.landmarks[scheme][:, 2])
        displacements.append((after.landmarks["many"] - before.landmarks["many"])[:, :2])
    errors = np.concatenate(displacements)
    distance = np.linalg.norm(errors, axis=-1)
    outlier = distance > 19.9
    assert outlier.mean() == pytest.approx(0.05 * factor, rel=0.25)
    assert distance.max() < 80.001 and 45 < distance[outlier].mean() < 55
    assert np.abs(errors[outlier].mean(0)).max() < 12  # in all directions
    np.testing.assert_allclose(errors[~outlier].std(0), 2.0 * factor, rtol=0.06)
    np.testing.assert_allclose(errors[~outlier].mean(0), 0, atol=0.2 * factor)
    assert abs(np.corrcoef(displacements[0][:, 0], displacements[1][:, 0])[0, 1]) < 0.15  # views are independent


def test_masks_grow_and_shrink(source: Path, degraded: Path) -> None:
    max_px = 2.0 * preset_factor(degraded)
    grown = []
    for before, after in pairs(source, degraded):
        old, new = load(before.mask), load(after.mask)
        assert new.dtype == np.uint8 and new.max() == 255 and new.min() == 0
        assert (old == new)[~boundary_band(old, int(max_px) + 1)].all()
        areas = old.sum() / 255, new.sum() / 255
        grown.append((areas[1] - areas[0]) / (2 * np.sqrt(np.pi * np.mean(areas))))  # over a circle's perimeter
    assert np.abs(grown).max() < 1.1 * max_px  # the image of a ball at the side is an ellipse
    assert np.abs(grown).max() > 0.3 * max_px and np.std(grown) > 0.2 * max_px


def test_labels_move_by_class(source: Path, degraded: Path) -> None:
    max_px = 2 * preset_factor(degraded)
    outline, middle = [], []
    for before, after in pairs(source, degraded):
        old, new = load(before.segmentation), load(after.segmentation)
        assert new.dtype == np.uint8 and set(np.unique(new)) == set(np.unique(old))
        assert (old == new)[~boundary_band(old, max_px + 1)].all()
        areas = [(labels > 0).sum() for labels in (old, new)]
        outline.append((areas[1] - areas[0]) / (2 * np.sqrt(np.pi * np.mean(areas))))
        inner = cv2.erode((old > 0).astype(np.uint8), np.ones((4 * max_px + 1,) * 2)) > 0
        line_px = (np.diff((old == 2).astype(int), axis=1) != 0)[inner[:, 1:]].sum()
        if line_px > 50:  # columns at the border between right and left
            middle.append(((new == 2) & inner).sum() / line_px - ((old == 2) & inner).sum() / line_px)
    for offsets_px in (outline, middle):
        assert 0.2 * max_px < np.abs(offsets_px).max() < 1.15 * max_px
    assert np.std(outline) > 0.15 * max_px


def test_images_have_different_gains_and_noise(source: Path, degraded: Path) -> None:
    factor = preset_factor(degraded)
    gains = []
    for before, after in pairs(source, degraded):
        assert load(after.image).dtype == np.uint8
        old, new = linear(before.image), linear(after.image)
        gain = new.mean((0, 1)) / old.mean((0, 1))
        gains.append(gain)
        noise = (new - gain * old) / np.sqrt(gain * old)
        assert noise.std() == pytest.approx(0.02 * factor, rel=0.05)
        assert abs((noise[:, 1:] * noise[:, :-1]).mean()) < 0.05 * noise.var()
    gains_rgb = np.array(gains)
    common = gains_rgb.mean(-1, keepdims=True)
    assert np.abs(common - 1).max() < 0.1 * factor + 0.02
    assert common.std() > 0.02 * factor
    assert 0.001 < np.abs(gains_rgb / common - 1).max() < 0.04 * factor


def test_dropped_views_lose_all_their_files(source: Path, degraded: Path) -> None:
    kept = {view.name for view in native.read_capture(degraded).views}
    all_names = {view.name for view in native.read_capture(source).views}
    assert kept < all_names and len(kept) == len(all_names) - (1 if preset_factor(degraded) == 1 else 3)
    normals = {
        str(path.relative_to(degraded / "normals").with_suffix("")) for path in degraded.glob("normals/**/*.png")
    }
    for folder in FOLDERS:
        names = {str(path.relative_to(degraded / folder).with_suffix("")) for path in (degraded / folder).rglob("*.*")}
        assert names == (normals if folder == "normals" else kept)
    assert len(kept) - len(normals) == (0 if preset_factor(degraded) == 1 else 1)
    description = native.read_capture(degraded).tags["spoiled"]
    assert all(name in description for name in all_names - kept)


def test_ground_truth_and_tags_are_kept_and_the_copy_is_valid(source: Path, degraded: Path) -> None:
    old, new = files(source), files(degraded)
    for name in ("scan.ply", "ground_truth.npz"):
        assert new[name] == old[name]
    settings = tomllib.loads(new["capture.toml"].decode())
    assert settings.pop("spoiled").startswith("preset ")
    assert settings == tomllib.loads(old["capture.toml"].decode())
    report = check_capture(degraded)
    assert report.eye_distance_mm == pytest.approx(90, abs=4)
    assert [path.name for path in degraded.parent.iterdir()] == ["capture"]


@pytest.mark.parametrize("bits", [8, 16])
def test_the_preset_none_changes_nothing(bits: int, tmp_path: Path) -> None:
    source = make(tmp_path / "source", distortion=DISTORTIONS["FULL_OPENCV"], bits=bits)
    degrade(source, tmp_path / "copy", preset=PRESETS["none"], seed=3)
    view_pairs = pairs(source, tmp_path / "copy")
    assert len(view_pairs) == 5
    for before, after in view_pairs:
        for old, new in (
            (before.image, after.image),
            (before.mask, after.mask),
            (before.normals, after.normals),
            (before.segmentation, after.segmentation),
        ):
            assert load(new).dtype == load(old).dtype
            np.testing.assert_array_equal(load(new), load(old))
        np.testing.assert_array_equal(after.landmarks["68"], before.landmarks["68"])
        np.testing.assert_allclose(after.camera.T_cam_world, before.camera.T_cam_world, rtol=0, atol=1e-14)
        np.testing.assert_array_equal(after.camera.intrinsics, before.camera.intrinsics)
        assert after.camera.distortion == before.camera.distortion
    assert "0.03" in (tmp_path / "copy" / "sparse" / "points3D.txt").read_text()


def test_images_of_16_bits_stay_so(tmp_path: Path) -> None:
    source = make(tmp_path / "source", bits=16)
    degrade(source, tmp_path / "copy", preset=PRESETS["studio"])
    for before, after in pairs(source, tmp_path / "copy"):
        new = load(after.image)
        assert new.dtype == np.uint16 and (new % 257 != 0).any()
        assert linear(after.image).mean() == pytest.approx(linear(before.image).mean(), rel=0.13)


def test_equal_seeds_give_equal_copies(tmp_path: Path) -> None:
    source = make(tmp_path / "source")
    copies = [
        files(degrade(source, tmp_path / f"copy{i}", preset=PRESETS["studio"], seed=seed))
        for i, seed in enumerate((7, 7, 8))
    ]
    assert copies[0] == copies[1]
    for name in copies[0].keys() & copies[2].keys():
        if name.split("/")[0] in ("images", "masks", "normals", "landmarks") or name == "sparse/images.txt":
            assert copies[0][name] != copies[2][name], name


def test_faults_of_single_views(tmp_path: Path) -> None:
    source = make(tmp_path / "source")
    ramp = np.arange(100, 220, dtype=np.uint8)[:, None]  # over the image's width; values above 167 will be clipped
    cv2.imwrite(str(source / "images" / "cam2.png"), np.tile(ramp, (160, 1, 3)))
    faults = {"cam0": ["shifted"], "cam1": ["black"], "cam2": ["exposure"], "cam3": ["black", "shifted"]}
    degrade(source, tmp_path / "copy", preset=PRESETS["none"], faults=faults)
    view_pairs = dict(
        zip((view.name for view in native.read_capture(source).views), pairs(source, tmp_path / "copy"), strict=True)
    )
    for name, (before, after) in view_pairs.items():
        shift = 30 if "shifted" in faults.get(name, []) else 0
        np.testing.assert_allclose(after.landmarks["68"], before.landmarks["68"] + [shift, 0, 0], atol=1e-9)
        np.testing.assert_allclose(after.camera.T_cam_world, before.camera.T_cam_world, rtol=0, atol=1e-14)
        for old, new in (
            (before.mask, after.mask),
            (before.normals, after.normals),
            (before.segmentation, after.segmentation),
            *([] if name in ("cam1", "cam2", "cam3") else [(before.image, after.image)]),
        ):
            np.testing.assert_array_equal(load(new)[:, shift:], load(old)[:, : 120 - shift])
            assert (load(new)[:, :shift] == load(old)[:, :1]).all()
    for name in ("cam1", "cam3"):
        assert load(view_pairs[name][1].image).max() == 0
    old, new = (linear(view.image) for view in view_pairs["cam2"])
    bright = 2.5 * old > 1.01
    assert 0.02 < bright.mean() < 0.98
    assert (new[bright] == 1).all()
    np.testing.assert_allclose(new[~bright], 2.5 * old[~bright], atol=0.006)  # half a step of 8 bits


def test_a_view_with_a_fault_is_kept_and_other_views_are_unchanged(tmp_path: Path) -> None:
    source = make(tmp_path / "source")
    names = [f"cam{i}" for i in range(5)]
    plain = files(degrade(source, tmp_path / "plain", preset=PRESETS["studio"], seed=2))
    dropped = next(name for name in names if f"images/{name}.png" not in plain)
    first = next(name for name in names if name != dropped)
    broken = files(
        degrade(source, tmp_path / "broken", preset=PRESETS["studio"], seed=2, faults={first: ["exposure", "shifted"]})
    )
    changed = {name for name in plain if plain[name] != broken.get(name)}
    assert changed == {"capture.toml", *(f"{folder}/{first}.png" for folder in FOLDERS[:4]), f"landmarks/{first}.json"}
    other = files(degrade(source, tmp_path / "other", preset=PRESETS["studio"], seed=2, faults={dropped: ["black"]}))
    assert f"images/{dropped}.png" in other
    assert sum(f"images/{name}.png" in other for name in names) == 4


@pytest.mark.parametrize(
    "options, what, got",
    [
        ({"faults": {"cam9": ["black"]}}, "no such view", "cam9"),
        ({"faults": {"cam1": ["black", "bent"]}}, "no such fault", "bent"),
        ({"preset": DegradationPreset(name="few", dropped_views=4)}, "Too few views", "5 views"),
        (
            {"preset": PRESETS["harsh"], "faults": dict.fromkeys(("cam0", "cam1", "cam2"), ["black"])},
            "Too few views",
            "3 of them with faults",
        ),
        ({"seed": -1}, "seed is out of range", "-1"),
    ],
)
def test_invalid_options_are_refused_before_anything_is_written(
    options: dict, what: str, got: str, tmp_path: Path
) -> None:
    source = make(tmp_path / "source")
    with pytest.raises(InputError) as error:
        degrade(source, tmp_path / "out" / "copy", **{"preset": PRESETS["studio"], **options})
    assert what in error.value.what and got in str(error.value)
    assert list(tmp_path.iterdir()) == [source]


def test_invalid_captures_are_refused_before_anything_is_written(tmp_path: Path) -> None:
    source = make(tmp_path / "source")
    copy = degrade(source, tmp_path / "copy", preset=PRESETS["studio"])
    before = files(tmp_path)

    def refused(root: Path, target: str, what: str) -> None:
        with pytest.raises(InputError, match=what):
            degrade(root, tmp_path / target, preset=PRESETS["studio"])

    refused(source, "copy", "exists already")
    refused(copy, "again", "degraded already")
    refused(tmp_path / "nowhere", "again", "capture folder is missing")
    assert files(tmp_path) == before
    shutil.rmtree(source / "landmarks")
    (source / "scan.ply").unlink()
    refused(source, "again", "position of the subject is unknown")
    cv2.imwrite(str(source / "masks" / "cam2.png"), np.zeros((160, 120), np.uint8))
    refused(source, "again", "mask is empty")
    assert not (tmp_path / "again").exists()


@pytest.mark.slow
@needs_shared
@pytest.mark.parametrize("name", ["ict_dev/neutral", "gnm_identity_a/happy"])
@pytest.mark.parametrize("preset", ["studio", "harsh"])
def test_degraded_heads_are_valid_captures(name: str, preset: str, tmp_path: Path) -> None:
    source = SHARED / "data" / "captures" / name
    report = check_capture(degrade(source, tmp_path / "copy", preset=PRESETS[preset], seed=1))
    capture: Capture = report.capture
    assert len(capture.views) == 22 - PRESETS[preset].dropped_views
    assert report.eye_distance_mm == pytest.approx(check_capture(source).eye_distance_mm, abs=5)
    points = read_scan(source / "scan.ply").vertices
    for before, after in pairs(source, tmp_path / "copy"):
        displacement_px = after.camera.project(points)[0] - before.camera.project(points)[0]
        assert np.sqrt((displacement_px**2).sum(-1).mean()) == pytest.approx(PRESETS[preset].camera_rms_px, rel=0.05)
