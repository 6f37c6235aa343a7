"""Depth maps in every form that is read, and COLMAP's dense maps written from their public description."""

import struct
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import OpenEXR
import pytest

from registration.capture import native, pixels
from registration.capture.dense_maps import depth_normals, read_colmap_map
from registration.capture.native_writer import CaptureDescription, write_capture
from registration.doctor.validation import validate_capture
from registration.errors import InputError
from registration.types import View
from tests.registration.capture import small


def write_colmap(path: Path, values: np.ndarray) -> None:
    """As COLMAP's Mat::Write: width&height&channels&, then values, x fastest, then y, then the channel."""
    height, width, channels = values.shape
    with path.open("wb") as file:
        file.write(f"{width}&{height}&{channels}&".encode("ascii"))
        for channel in range(channels):
            for y in range(height):
                file.write(struct.pack(f"<{width}f", *values[y, :, channel]))


def exact_depth(view: View) -> np.ndarray:
    """Depth of the ball along the optical axis at each distorted pixel, metres; 0 beside it."""
    camera = view.camera
    y, x = np.mgrid[: camera.height_px, : camera.width_px] + 0.5
    grid = np.stack([x, y], -1).reshape(-1, 1, 2)
    coefficients = np.array(camera.distortion) if camera.distortion else None
    plane = cv2.undistortPoints(grid, camera.intrinsics, coefficients)[:, 0]
    rays = np.column_stack([plane, np.ones(len(plane))])
    centre = camera.T_cam_world[:3, 3]
    squared, along = (rays**2).sum(1), rays @ centre
    inside = along**2 - squared * (centre @ centre - small.RADIUS_M**2)
    depth = np.where(inside > 0, (along - np.sqrt(np.maximum(inside, 0))) / squared, 0)
    return depth.reshape(camera.height_px, camera.width_px).astype(np.float32)


def write_depths(root: Path, kind: str) -> None:
    """Depth maps of all views of a small capture, and their unit where it must be stated."""
    (root / "depth").mkdir()
    for view in native.read_capture(root).views:
        depth, stem = exact_depth(view), root / "depth" / view.name
        if kind == "png":
            cv2.imwrite(f"{stem}.png", np.round(depth * 1e4).astype(np.uint16))  # tenths of millimetres
        elif kind == "npy":
            np.save(f"{stem}.npy", np.where(depth > 0, depth, np.nan))
        elif kind == "tif":
            cv2.imwrite(f"{stem}.tif", depth * 1000)
        elif kind in ("Z", "Y"):
            header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
            OpenEXR.File(header, {kind: np.where(depth > 0, depth, np.inf)}).write(f"{stem}.exr")
        else:
            write_colmap(Path(f"{stem}.png.{kind}.bin"), depth[..., None])
    unit = {"tif": "mm"}.get(kind)
    if kind == "png":
        for file in (root / "depth").glob("*.png"):
            cv2.imwrite(str(file), np.round(cv2.imread(str(file), cv2.IMREAD_UNCHANGED) / 10).astype(np.uint16))
        unit = "mm"
    if unit is not None:
        with (root / "capture.toml").open("a", encoding="utf-8") as file:
            file.write(f'\n[depth]\nunit = "{unit}"\n')


@pytest.mark.parametrize("kind", ["npy", "tif", "Z", "Y", "geometric", "photometric"])
@pytest.mark.parametrize("distortion", [(), small.DISTORTIONS["OPENCV"]])
def test_normals_from_depths_are_those_of_the_surface(tmp_path: Path, kind: str, distortion: tuple[float, ...]) -> None:
    root = small.make(tmp_path / "capture", drop=("normals",), distortion=distortion)
    exact = native.read_capture(small.make(tmp_path / "exact", distortion=distortion))
    write_depths(root, kind)
    capture = native.read_capture(root)
    for downsample in (1, 2):
        for view, known in zip(capture.views, exact.views, strict=True):
            found = pixels.read_view(view, capture, downsample=downsample).normals
            expected = pixels.read_view(known, exact, downsample=downsample).normals
            assert found is not None and expected is not None
            both = found.any(-1) & expected.any(-1)
            assert both.sum() > 0.7 * expected.any(-1).sum()
            cosine = (found * expected).sum(-1)[both]
            assert np.degrees(np.arccos(np.clip(np.median(cosine), -1, 1))) < 1.5 and np.quantile(cosine, 0.02) > 0.98


def test_the_ledger_counts_depth_maps(tmp_path: Path) -> None:
    root = small.make(tmp_path / "capture", drop=("normals",))
    write_depths(root, "geometric")
    ledger = validate_capture(native.read_capture(root))
    rows = {row.name: row for row in ledger.channels}
    assert rows["depth"].files == rows["depth"].matched == 5 and "scan normals" not in rows
    assert 0.7 * rows["depth"].total < rows["depth"].counted and not rows["normals"].matched
    assert not ledger.unread


def test_whole_millimetres_are_coarse_but_have_a_unit(tmp_path: Path) -> None:
    root = small.make(tmp_path / "capture", drop=("normals",))
    write_depths(root, "png")
    capture = native.read_capture(root)
    depth = pixels.read_depth(capture.views[0])
    np.testing.assert_allclose(depth, exact_depth(capture.views[0]), atol=6e-4)
    settings = root / "capture.toml"
    settings.write_text(settings.read_text(encoding="utf-8").split("[depth]")[0], encoding="utf-8")
    with pytest.raises(InputError, match="have no unit") as caught:
        validate_capture(native.read_capture(root))
    assert 'unit = "mm"' in caught.value.fix


def test_maps_of_colmap_are_read_as_they_are_described(tmp_path: Path) -> None:
    values = np.arange(4 * 6 * 3, dtype=np.float32).reshape(4, 6, 3)
    camera = small.camera(width_px=6, height_px=4)
    write_colmap(tmp_path / "a.geometric.bin", values)
    np.testing.assert_array_equal(read_colmap_map(tmp_path / "a.geometric.bin", "normal map", camera, 3), values)
    twice = read_colmap_map(tmp_path / "a.geometric.bin", "map", small.camera(width_px=12, height_px=8), 3)
    np.testing.assert_array_equal(twice, values.repeat(2, 0).repeat(2, 1))


def test_normal_maps_of_colmap_are_normal_maps(tmp_path: Path) -> None:
    root = small.make(tmp_path / "capture")
    expected = native.read_capture(small.make(tmp_path / "exact"))
    for view in expected.views:
        assert view.normals is not None
        stored = pixels.decode_normals(pixels.read_normals(view.normals, view.camera))
        (root / "normals" / f"{view.name}.png").unlink()
        write_colmap(root / "normals" / f"{view.name}.png.geometric.bin", stored)
    found = native.read_capture(root)
    assert validate_capture(found).channels[2].counted == validate_capture(expected).channels[2].counted
    for first, second in zip(expected.views, found.views, strict=True):
        ours, theirs = (pixels.read_view(v, c).normals for v, c in ((first, expected), (second, found)))
        np.testing.assert_array_equal(ours, theirs)


@pytest.mark.parametrize(
    ("name", "content", "got"),
    [
        ("cam0.png.geometric.bin", b"120&160&1&" + bytes(10), "10 bytes"),
        ("cam0.png.geometric.bin", b"120&160&3&" + bytes(120 * 160 * 12), "3"),
        ("cam0.png.geometric.bin", b"160&120&1&" + bytes(120 * 160 * 4), "160 x 120 px"),
        ("cam0.geometric.bin", b"-1&160&1&", "another start"),
        ("cam0.npy", b"\x93NUMPY\x01\x00", "ValueError"),
        ("cam0.npy", b"no array", "ValueError"),
        ("cam0.tif", b"II*\0", "a file that starts with"),
        ("cam0.exr", b"v/1\x01", ""),
    ],
)
def test_damaged_depth_maps_are_refused(tmp_path: Path, name: str, content: bytes, got: str) -> None:
    root = small.make(tmp_path / "capture", drop=("normals",))
    (root / "depth").mkdir()
    (root / "depth" / name).write_bytes(content)
    with pytest.raises(InputError, match="depth map cannot be used") as caught:
        validate_capture(native.read_capture(root))
    assert got in str(caught.value.got) and caught.value.where == str(root / "depth" / name)


@pytest.mark.parametrize("table", ["[depth]\nunit = 1000", "[depth]\nscale = 1", '[depth]\nunit = "furlong"'])
def test_a_unit_that_is_none_is_refused(tmp_path: Path, table: str) -> None:
    root = small.make(tmp_path / "capture")
    with (root / "capture.toml").open("a", encoding="utf-8") as file:
        file.write(f"\n{table}\n")
    with pytest.raises(InputError, match="unit of the depth maps"):
        native.read_capture(root)


def test_nothing_at_steps_and_beside_missing_depths() -> None:
    """A plane at half a metre with a nearer half, and a hole."""
    rays = np.stack([*np.meshgrid(np.linspace(-0.1, 0.1, 41), np.linspace(-0.1, 0.1, 41)), np.ones((41, 41))], -1)
    depth = np.full((41, 41), 0.5)
    depth[:, 20:] = 0.45
    depth[5:9, 5:9] = 0
    normals = depth_normals(depth, rays)
    assert not normals[:, 19:21].any() and not normals[4:10, 4:10].any()
    np.testing.assert_allclose(normals[15:35, 3:16], np.broadcast_to([0, 0, -1.0], (20, 13, 3)), atol=1e-9)


@pytest.mark.parametrize("distortion", [(), small.DISTORTIONS["OPENCV"]])
def test_depths_and_confidences_of_a_view_on_its_own_grid(tmp_path: Path, distortion: tuple[float, ...]) -> None:
    """Written beside normals, with a hole; the depth of the undistorted, reduced pixels is the ball's."""
    view = small.synthetic_view("cam0", small.camera(0.2, distortion=distortion))
    depth = exact_depth(View(name="cam0", camera=view.camera, image=tmp_path))
    depth[60:80, 50:60] = 0
    confidence = np.where(np.arange(120) < 60, 0.2, 1.0)[None].repeat(160, 0)
    views = [replace(view, depth=depth, confidence=confidence), small.synthetic_view("cam1", small.camera(0.8))]
    root = write_capture(
        tmp_path / "capture", views, CaptureDescription(subject="a", expression="b", classes=small.CLASSES)
    )
    capture = native.read_capture(root)
    first, second = capture.views
    assert first.depth is not None and first.confidence is not None and second.confidence is None
    np.testing.assert_array_equal(pixels.read_depth(first), depth)
    for downsample in (1, 2):
        found = pixels.read_view(first, capture, downsample=downsample)
        assert found.depth is not None and found.confidence is not None and found.normals is not None
        expected = exact_depth(View(name="cam0", camera=found.camera, image=tmp_path))
        inside = found.normals[..., 2] < -0.5
        known = inside & (found.depth > 0)
        slope = np.abs(np.gradient(expected)).max(0)  # of a block with a missing pixel the middle is elsewhere
        assert (np.abs(found.depth - expected)[known] < 1e-5 + 0.2 * slope[known]).all()
        assert np.median(np.abs(found.depth - expected)[known]) < 3e-5
        assert known.sum() > 0.9 * inside.sum() and (inside & (found.depth == 0)).sum() > 100 / downsample**2
        np.testing.assert_allclose(np.unique(found.confidence.round(2))[[0, -1]], [0.2, 1.0])
    assert pixels.read_view(second, capture).depth is None
    row = next(row for row in validate_capture(capture).channels if row.name == "depth")
    assert row.matched == 1 and 0.9 * row.total < row.counted < row.total


@pytest.mark.parametrize(
    "content", [np.zeros((160, 120), np.uint16), np.zeros((160, 120, 3), np.uint8), np.zeros((8, 8), np.uint8)]
)
def test_maps_that_are_no_confidences_are_refused(tmp_path: Path, content: np.ndarray) -> None:
    root = small.make(tmp_path / "capture")
    (root / "confidence").mkdir()
    cv2.imwrite(str(root / "confidence" / "cam0.png"), content)
    capture = native.read_capture(root)
    with pytest.raises(InputError, match="confidence map") as caught:
        pixels.read_view(capture.views[0], capture)
    assert caught.value.where == str(root / "confidence" / "cam0.png")
