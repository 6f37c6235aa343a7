import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from registration.capture import native, pixels
from registration.capture.native_writer import CaptureDescription, ViewArrays, write_capture
from registration.capture.pixels import read_view, undistort_landmarks
from registration.errors import InputError
from registration.frames import srgb_to_linear
from registration.types import Camera, Capture, ViewPixels
from tests.conftest import SHARED, needs_shared
from tests.registration.capture.small import CLASSES, DISTORTIONS, camera, landmarks_68, make, synthetic_view


def one_view(root: Path, view: ViewArrays, bits: int = 16) -> Capture:
    description = CaptureDescription(subject="s", expression="e", classes=CLASSES)
    return native.read_capture(write_capture(root, [view], description, bits=bits))


def centroid_and_radius(coverage: np.ndarray) -> np.ndarray:
    """Centroid (x, y) and mean radius of a region, px: sub-pixel however ragged its edge is."""
    row, column = np.mgrid[: coverage.shape[0], : coverage.shape[1]] + 0.5
    area = coverage.sum()
    return np.array([(coverage * column).sum() / area, (coverage * row).sum() / area, np.sqrt(area / np.pi)])


@pytest.mark.parametrize("model", DISTORTIONS)
@pytest.mark.parametrize("downsample", [1, 4])
def test_images_masks_labels_and_normals_are_undistorted_consistently(
    tmp_path: Path, model: str, downsample: int
) -> None:
    """Compared with an image that was traced without distortion."""
    cam = camera(0.3, distortion=DISTORTIONS[model], width_px=240, height_px=320)
    capture = one_view(tmp_path / "bent", synthetic_view("a", cam))
    straight = one_view(tmp_path / "straight", synthetic_view("a", replace(cam, distortion=())))
    displacement_px = capture.views[0].landmarks["68"][:, :2] - straight.views[0].landmarks["68"][:, :2]
    assert np.abs(displacement_px).max() > 2.5  # or the test would pass without undistortion
    actual = read_view(capture.views[0], capture, downsample=downsample)
    ideal = read_view(straight.views[0], straight, downsample=downsample)
    assert actual.camera.distortion == () and actual.mask is not None and ideal.mask is not None
    np.testing.assert_array_equal(actual.camera.intrinsics, ideal.camera.intrinsics)
    assert actual.label_coverage is not None and ideal.label_coverage is not None
    assert (actual.valid[ideal.mask > 0] > 0.999).all()
    tolerance_px = 0.1 / downsample
    np.testing.assert_allclose(centroid_and_radius(actual.mask), centroid_and_radius(ideal.mask), atol=tolerance_px)
    for index in (1, 2):
        np.testing.assert_allclose(
            centroid_and_radius(actual.label_coverage[..., index]),
            centroid_and_radius(ideal.label_coverage[..., index]),
            atol=tolerance_px,
        )
    inside = cv2.erode(np.minimum(actual.mask, ideal.mask), np.ones((3, 3))) == 1
    assert inside.sum() > 15_000 / downsample**2
    for part, expected in ((actual.rgb, ideal.rgb), (actual.normals, ideal.normals)):
        assert part is not None and expected is not None
        by_row, by_column = np.gradient(expected, axis=(0, 1))
        system = np.column_stack([by_column[inside].ravel(), by_row[inside].ravel()])
        shift_px = np.linalg.lstsq(system, (part - expected)[inside].ravel(), rcond=None)[0]
        assert np.abs(shift_px).max() < 0.01
        assert np.abs(part - expected)[inside].max() < 0.01
    np.testing.assert_allclose(
        undistort_landmarks(capture.views[0], "68"), straight.views[0].landmarks["68"], atol=1e-6
    )


@pytest.mark.parametrize("distortion", [(), DISTORTIONS["OPENCV"]])
@pytest.mark.parametrize("downsample", [1, 3, 7])
def test_points_appear_where_the_downsampled_camera_projects_them(
    tmp_path: Path, distortion: tuple[float, ...], downsample: int
) -> None:
    """Bright dots on landmarks; 3 and 7 do not divide the image's sides."""
    cam = camera(0.2, distortion=distortion, width_px=241, height_px=323)
    capture = one_view(tmp_path / "capture", synthetic_view("a", cam))
    spread_px = max(2.5, 0.8 * downsample)  # a dot inside a single block would be located at the block's centre
    for index in (8, 27, 36, 45):
        point = landmarks_68()[index : index + 1]
        x, y = capture.views[0].landmarks["68"][index, :2]
        row, column = np.mgrid[:323, :241] + 0.5
        dot = np.exp(-((column - x) ** 2 + (row - y) ** 2) / 2 / spread_px**2)
        cv2.imwrite(str(capture.views[0].image), np.round(65535 * dot).astype(np.uint16))
        view = read_view(capture.views[0], capture, downsample=downsample)
        weight = view.rgb[..., 1]
        row, column = np.mgrid[: weight.shape[0], : weight.shape[1]] + 0.5
        centre = np.array([(weight * column).sum(), (weight * row).sum()]) / weight.sum()
        np.testing.assert_allclose(centre, view.camera.project(point)[0][0], atol=0.05)
        assert (view.camera.width_px, view.camera.height_px) == (241 // downsample, 323 // downsample)


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_downsampling_averages_linear_light_and_not_srgb(tmp_path: Path, dtype: type) -> None:
    top = np.iinfo(dtype).max
    rgb = np.random.default_rng(0).integers(0, top, (160, 120, 3), endpoint=True, dtype=dtype)
    capture = one_view(tmp_path / "capture", ViewArrays(name="a", camera=camera(), rgb=rgb))
    full = read_view(capture.views[0], capture)
    np.testing.assert_allclose(full.rgb, srgb_to_linear(rgb / top), atol=1e-6)
    assert full.mask is None and full.normals is None and full.label_coverage is None
    for downsample in (2, 4, 8):
        view = read_view(capture.views[0], capture, downsample=downsample)
        np.testing.assert_allclose(view.rgb.mean((0, 1), np.float64), full.rgb.mean((0, 1), np.float64), rtol=1e-6)
        blocks = full.rgb.reshape(160 // downsample, downsample, 120 // downsample, downsample, 3).mean((1, 3))
        np.testing.assert_allclose(view.rgb, blocks, atol=1e-5)
        assert (view.valid == 1).all()


def test_masks_labels_and_normals_are_downsampled_by_coverage(tmp_path: Path) -> None:
    plain = synthetic_view("a", camera(0.3))
    capture = one_view(tmp_path / "capture", plain)
    view = read_view(capture.views[0], capture, downsample=8)
    assert view.mask is not None and view.label_coverage is not None and view.normals is not None
    assert plain.mask is not None and plain.labels is not None and plain.normals is not None
    blocks = plain.mask.reshape(20, 8, 15, 8).mean((1, 3))
    np.testing.assert_allclose(view.mask, blocks, atol=1e-6)
    for index in range(len(CLASSES)):
        counted = (plain.labels == index).reshape(20, 8, 15, 8).mean((1, 3))
        np.testing.assert_allclose(view.label_coverage[..., index], counted, atol=1e-6)
    np.testing.assert_allclose(view.label_coverage.sum(-1), 1, atol=1e-6)
    length = np.linalg.norm(view.normals, axis=-1)
    np.testing.assert_allclose(length[blocks > 0], 1, atol=1e-5)
    assert (length[blocks == 0] == 0).all()
    summed = plain.normals.reshape(20, 8, 15, 8, 3).sum((1, 3))[blocks > 0]
    expected = summed / np.linalg.norm(summed, axis=-1, keepdims=True)
    np.testing.assert_allclose(view.normals[blocks > 0], expected, atol=1e-4)


def test_pixels_without_a_source_are_invalid_and_have_no_weight(tmp_path: Path) -> None:
    """A pincushion image has no source for the corners; a constant image stays constant up to the border."""
    cam = camera(distortion=(3.0, 0.0, 0.0, 0.0))
    shape = (cam.height_px, cam.width_px)
    view = ViewArrays(
        name="a",
        camera=cam,
        rgb=np.full((*shape, 3), 200, np.uint8),
        mask=np.ones(shape, bool),
        labels=np.full(shape, 2, np.uint8),
    )
    capture = one_view(tmp_path / "capture", view)
    actual = read_view(capture.views[0], capture, downsample=4)
    assert actual.mask is not None and actual.label_coverage is not None
    assert actual.valid[0, 0] == 0 and actual.valid[20, 15] == 1 and 0.5 < actual.valid.mean() < 0.98
    partly = actual.valid > 0.05
    assert ((actual.valid > 0.05) & (actual.valid < 0.95)).sum() > 10
    np.testing.assert_allclose(actual.rgb[partly], srgb_to_linear(np.array(200 / 255)), rtol=1e-3)
    np.testing.assert_allclose(actual.mask[partly], 1, rtol=1e-3)
    np.testing.assert_allclose(actual.label_coverage[partly] @ [0, 0, 1], 1, rtol=1e-3)
    assert (actual.rgb[actual.valid == 0] == 0).all() and (actual.mask[actual.valid == 0] == 0).all()


def test_strips_of_an_image_join_without_a_seam(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    capture = one_view(tmp_path / "capture", synthetic_view("a", camera(0.3, distortion=DISTORTIONS["FULL_OPENCV"])))

    def arrays(view: ViewPixels) -> list[np.ndarray]:
        return [value for value in vars(view).values() if isinstance(value, np.ndarray)]

    whole = arrays(read_view(capture.views[0], capture, downsample=2))
    monkeypatch.setattr(pixels, "STRIP_PIXELS", 1000)
    for a, b in zip(whole, arrays(read_view(capture.views[0], capture, downsample=2)), strict=True):
        np.testing.assert_allclose(a, b, atol=2e-5)


def save(path: Path, array: np.ndarray, mode: str) -> None:
    Image.fromarray(array, mode).save(path)


@pytest.mark.parametrize("kind", ["gray", "gray16", "gray alpha", "rgba", "palette", "jpeg", "tiff"])
def test_supported_image_types(tmp_path: Path, kind: str) -> None:
    capture = one_view(tmp_path / "capture", synthetic_view("a", camera()))
    view = capture.views[0]
    rng = np.random.default_rng(1)
    gray = cv2.GaussianBlur(rng.integers(0, 256, (160, 120), dtype=np.uint8), (0, 0), 3)
    rgb = np.stack([gray, 255 - gray, gray // 2], -1)
    alpha = rng.integers(0, 256, (160, 120), dtype=np.uint8)
    expected = np.repeat(gray[..., None], 3, -1) / 255 if "gray" in kind else rgb / 255
    tolerance = 1e-5
    if kind == "gray":
        Image.fromarray(gray).save(view.image)
    elif kind == "gray16":
        Image.fromarray(gray.astype(np.uint16) * 257).save(view.image)
    elif kind == "gray alpha":
        Image.merge("LA", [Image.fromarray(gray), Image.fromarray(alpha)]).save(view.image)
    elif kind == "rgba":
        Image.fromarray(np.dstack([rgb, alpha])).save(view.image)
    elif kind == "palette":
        quantised = Image.fromarray(rgb).quantize(64)
        quantised.save(view.image)
        expected = np.array(quantised.convert("RGB")) / 255
    else:
        view = replace(view, image=view.image.with_suffix(f".{kind}"))
        Image.fromarray(rgb).save(view.image, **({"quality": 100, "subsampling": 0} if kind == "jpeg" else {}))
        tolerance = 0.03 if kind == "jpeg" else tolerance
    actual = read_view(view, capture)
    np.testing.assert_allclose(actual.rgb, srgb_to_linear(expected), atol=tolerance)


def test_palette_label_maps_keep_their_indices(tmp_path: Path) -> None:
    capture = one_view(tmp_path / "capture", synthetic_view("a", camera()))
    path = capture.views[0].segmentation
    assert path is not None
    labels = np.random.default_rng(2).integers(0, 3, (160, 120), dtype=np.uint8)
    image = Image.fromarray(labels, "P")
    image.putpalette([0, 0, 0, 255, 0, 0, 0, 0, 255])
    image.save(path)
    np.testing.assert_array_equal(pixels.read_labels(path, capture.views[0].camera, CLASSES), labels)


def test_exif_rotations_are_ignored_as_by_the_calibration(tmp_path: Path) -> None:
    capture = one_view(tmp_path / "capture", synthetic_view("a", camera()))
    image = capture.views[0].image.with_suffix(".jpg")
    exif = Image.Exif()
    exif[0x0112] = 6  # rotation by 90 degrees
    Image.fromarray(np.full((160, 120, 3), 77, np.uint8)).save(image, exif=exif)
    assert read_view(replace(capture.views[0], image=image), capture).rgb.shape == (160, 120, 3)


def test_damage_in_the_middle_of_a_file_is_an_error(tmp_path: Path) -> None:
    capture = native.read_capture(make(tmp_path / "capture"))
    path = capture.views[2].image
    content = bytearray(path.read_bytes())
    content[len(content) // 2 : len(content) // 2 + 64] = bytes(64)
    path.write_bytes(content)
    with pytest.raises(InputError, match="The image cannot be decoded") as caught:
        read_view(capture.views[2], capture)
    assert caught.value.where == str(path)


@pytest.mark.parametrize("downsample", [0, 121])
def test_downsampling_to_no_pixel_is_refused(tmp_path: Path, downsample: int) -> None:
    capture = native.read_capture(make(tmp_path / "capture"))
    with pytest.raises(InputError, match="cannot be reduced by this factor"):
        read_view(capture.views[0], capture, downsample=downsample)


MEASURE = """
import resource, sys
from pathlib import Path
from registration.capture import native, pixels
capture = native.read_capture(Path(sys.argv[1]))
before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
pixels.read_view(capture.views[0], capture, downsample=8)
print((resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) / 1024)
"""


@pytest.mark.slow
@pytest.mark.parametrize("distortion", [(), (-0.1, 0.02, 0.001, 0.001)])
def test_a_25_megapixel_view_needs_less_than_a_gigabyte(tmp_path: Path, distortion: tuple[float, ...]) -> None:
    small = synthetic_view("a", camera(width_px=512, height_px=768))
    cam: Camera = replace(small.camera.scaled(4096, 6144), distortion=distortion)
    big = ViewArrays(
        name="a",
        camera=cam,
        rgb=np.tile(np.random.default_rng(0).integers(0, 65536, (768, 512, 3), dtype=np.uint16), (8, 8, 1)),
        mask=small.mask.repeat(8, 0).repeat(8, 1) if small.mask is not None else None,
        normals=small.normals.repeat(8, 0).repeat(8, 1) if small.normals is not None else None,
        labels=small.labels.repeat(8, 0).repeat(8, 1) if small.labels is not None else None,
    )
    one_view(tmp_path / "capture", big)
    command = [sys.executable, "-c", MEASURE, str(tmp_path / "capture")]
    grown_mb = float(subprocess.run(command, check=True, capture_output=True, text=True).stdout)
    assert grown_mb < 1000


@needs_shared
def test_a_shared_view_at_half_size() -> None:
    capture = native.read_capture(SHARED / "data" / "captures" / "ict_dev" / "neutral")
    view = read_view(capture.views[2], capture, downsample=2)
    assert view.rgb.shape == (360, 240, 3) and view.rgb.min() >= 0 and view.rgb.max() <= 1
    assert view.mask is not None and view.normals is not None and view.label_coverage is not None
    np.testing.assert_allclose(view.mask, 1 - view.label_coverage[..., 0], atol=1e-5)
    facing = view.normals[view.mask == 1]
    assert np.median(facing[:, 2]) < -0.5  # the camera looks along +z, at surfaces that face it
