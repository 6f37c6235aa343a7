from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import OpenEXR
import pytest
from PIL import Image

from registration.capture import native, pixels
from registration.capture.colour import ENCODINGS, to_rec709
from registration.capture.file_colour import colour_name
from registration.capture.headers import read_header
from registration.capture.native_writer import CaptureDescription, write_capture
from registration.degrading import degradation, degrade
from registration.doctor.report import check_capture
from registration.errors import InputError
from registration.frames import linear_to_srgb, srgb_to_linear
from registration.types import Camera, Capture, Colour
from tests.registration.capture.small import camera, make, synthetic_view

HEIGHT_PX, WIDTH_PX = 160, 120
CAMERA = camera()
LIGHT = np.random.default_rng(1).uniform(0, 1, (HEIGHT_PX, WIDTH_PX, 3)).astype(np.float32)


def read(path: Path, colour: Colour = Colour(), cam: Camera = CAMERA) -> np.ndarray:  # noqa: B008
    return pixels.read_image(path, cam, colour)


def light_of(path: Path, colour: Colour = Colour()) -> np.ndarray:  # noqa: B008
    """Linear light of an image that was converted."""
    image = read(path, colour)
    assert image.dtype == np.uint16
    return srgb_to_linear(image / 65535)


@pytest.mark.parametrize(
    "name, code, light",
    [  # published anchors: 18 % grey, black, 90 % white
        ("arri_logc3", 0.391007, 0.18),
        ("arri_logc3", 0.092809, 0.0),
        ("arri_logc4", 0.278396, 0.18),
        ("arri_logc4", 95 / 1023, 0.0),
        ("sony_slog3", 420 / 1023, 0.18),
        ("sony_slog3", 95 / 1023, 0.0),
        ("sony_slog3_cine", 598 / 1023, 0.90),
        ("canon_log3", 0.343389, 0.18),
        ("canon_log3", 0.12512219, 0.0),
        ("panasonic_vlog", 0.423311, 0.18),
        ("panasonic_vlog", 0.125, 0.0),
        ("panasonic_vlog", 602 / 1023, 0.90),
        ("blackmagic_film5", 0.383562, 0.18),
        ("blackmagic_film5", 0.092466, 0.0),
        ("red_log3g10", 1 / 3, 0.18),
        ("red_log3g10", 0.09155, 0.0),
        ("rec709", 0.409, 0.18),
        ("adobe_rgb", 0.5, 0.21775),
        ("srgb", 0.5, 0.21404),
        ("linear", 0.25, 0.25),
    ],
)
def test_curves_meet_published_values(name: str, code: float, light: float) -> None:
    assert float(ENCODINGS[name].curve(np.array([code]))[0]) == pytest.approx(light, rel=0.01, abs=4e-4)


@pytest.mark.parametrize("name", ENCODINGS)
def test_curves_increase_without_a_step_and_white_stays_white(name: str) -> None:
    codes = np.linspace(0, 1, 20001)
    light = ENCODINGS[name].curve(codes)
    steps = np.diff(light)
    assert (steps >= 0).all() and steps.max() < 20 * max(np.median(steps), light[-1] * 1e-4)
    np.testing.assert_allclose(to_rec709(ENCODINGS[name].primaries) @ [1, 1, 1], [1, 1, 1], atol=1e-9)


@pytest.mark.parametrize(
    "name, matrix",
    [
        ("display_p3", [[1.22494, -0.22494, 0], [-0.04206, 1.04206, 0], [-0.01964, -0.07864, 1.09827]]),
        ("adobe_rgb", [[1.39836, -0.39836, 0], [0, 1, 0], [0, -0.04293, 1.04293]]),
        (
            "arri_logc3",
            [[1.617523, -0.537287, -0.080237], [-0.070573, 1.334613, -0.26404], [-0.021102, -0.226954, 1.248056]],
        ),
    ],
)
def test_primaries_become_those_of_srgb(name: str, matrix: list[list[float]]) -> None:
    np.testing.assert_allclose(to_rec709(ENCODINGS[name].primaries), matrix, atol=2e-4)


def test_matrix_and_gain_apply_where_they_are_stated(tmp_path: Path) -> None:
    path = tmp_path / "a.png"
    Image.fromarray(np.full((HEIGHT_PX, WIDTH_PX, 3), (51, 102, 153), np.uint8)).save(path)
    values = np.array([0.2, 0.4, 0.6])
    matrix = ((0.5, 0.25, 0.0, 0.1), (0.0, 1.0, 0.0, 0.0), (0.1, 0.0, 0.5, -0.05))
    M = np.array(matrix)
    moved = M[:, :3] @ values + M[:, 3]  # 0.3, 0.4, 0.27
    np.testing.assert_allclose(moved, [0.3, 0.4, 0.27])
    encoded = Colour(matrix=matrix, matrix_space="encoded", gain=1.5)
    np.testing.assert_allclose(light_of(path, encoded)[0, 0], 1.5 * srgb_to_linear(moved), atol=1e-4)
    linear = Colour(encoding="linear", matrix=matrix, gain=0.5)
    np.testing.assert_allclose(light_of(path, linear)[0, 0], 0.5 * moved, atol=1e-4)
    after = Colour(matrix=tuple(row[:3] for row in matrix))
    np.testing.assert_allclose(light_of(path, after)[0, 0], M[:, :3] @ srgb_to_linear(values), atol=1e-4)


def write_exr(path: Path, channels: dict[str, np.ndarray], **more: object) -> None:
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage, **more}
    OpenEXR.File(header, channels).write(str(path))


@pytest.mark.parametrize("kind", ["float tiff", "grey float tiff", "half exr", "float exr", "grey exr"])
def test_floating_point_images_are_read_if_they_are_said_to_be_linear(tmp_path: Path, kind: str) -> None:
    path = tmp_path / ("a.tif" if "tiff" in kind else "a.exr")
    if kind == "float tiff":
        cv2.imwrite(str(path), LIGHT[..., ::-1])
    elif kind == "grey float tiff":
        cv2.imwrite(str(path), LIGHT[..., 0])
    elif kind == "grey exr":
        write_exr(path, {"Y": np.ascontiguousarray(LIGHT[..., 0])})
    else:
        write_exr(path, {"RGB": LIGHT.astype(np.float16 if kind == "half exr" else np.float32)})
    expected = np.repeat(LIGHT[..., :1], 3, 2) if "grey" in kind else LIGHT
    assert read_header(path, "image").floating
    np.testing.assert_allclose(light_of(path, Colour(encoding="linear")), expected, atol=5e-4)
    with pytest.raises(InputError, match="holds floating-point numbers") as caught:
        read(path)
    assert 'encoding = "linear"' in caught.value.fix
    with pytest.raises(InputError, match="unusable pixel type"):
        read_header(path, "mask")


def test_the_primaries_of_an_exr_count(tmp_path: Path) -> None:
    path = tmp_path / "a.exr"
    p3 = np.array([0.68, 0.32, 0.265, 0.69, 0.15, 0.06, 0.3127, 0.329], np.float32)
    write_exr(path, {"RGB": LIGHT}, chromaticities=tuple(map(float, p3)))
    expected = LIGHT @ to_rec709(ENCODINGS["display_p3"].primaries).T
    np.testing.assert_allclose(light_of(path, Colour(encoding="linear")), expected.clip(0, 1), atol=1e-4)


def test_light_without_measure_is_refused(tmp_path: Path) -> None:
    path, linear = tmp_path / "a.tif", Colour(encoding="linear")
    cv2.imwrite(str(path), 10 + LIGHT)
    with pytest.raises(InputError, match="brighter than 1") as caught:
        read(path, linear)
    gain = float(caught.value.fix.split("gain = ")[1].split()[0])
    assert 0.4 < light_of(path, replace(linear, gain=gain)).mean() < 0.55
    cv2.imwrite(str(path), np.where(LIGHT > 0.99, np.nan, LIGHT))
    with pytest.raises(InputError, match="not finite"):
        read(path, linear)


def test_faulty_exr_files_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.exr"
    for channels, more, got in (
        ({"A": LIGHT[..., 0].copy()}, {}, "A"),
        ({"Z": LIGHT[..., 0].copy(), "R": LIGHT[..., 0].copy()}, {}, "R, Z"),
        ({"RGB": LIGHT}, {"displayWindow": (np.array([0, 0], np.int32), np.array([999, 999], np.int32))}, "to"),
    ):
        write_exr(path, channels, **more)
        with pytest.raises(InputError, match="not a readable image") as caught:
            read_header(path, "image")
        assert got in str(caught.value.got)
    write_exr(path, {"RGB": LIGHT})
    content = bytearray(path.read_bytes())
    path.write_bytes(content.replace(b"\0B\0", b"\0\xff\0", 1))
    with pytest.raises(InputError, match="not a readable image"):
        read_header(path, "image")
    path.write_bytes(content[:100])
    with pytest.raises(InputError, match="not a readable image"):
        read_header(path, "image")
    content[len(content) // 2 : len(content) // 2 + 400] = bytes(400)
    path.write_bytes(content)
    with pytest.raises(InputError, match="cannot be decoded"):
        read(path, Colour(encoding="linear"))


def described(root: Path, text: str) -> Capture:
    path = root / "capture.toml"
    path.write_text(path.read_text() + text)
    return native.read_capture(root)


def test_a_capture_states_colours_of_all_views_and_of_some(tmp_path: Path) -> None:
    text = """
[colour]
encoding = "linear"
gain = 2
[colour.views.cam1]
encoding = "sony_slog3"
matrix = [[1, 0, 0], [0, 1, 0], [0, 0, 1]]
matrix_space = "encoded"
"""
    capture = described(make(tmp_path / "c"), text)
    identity = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
    assert capture.views[0].colour == Colour(encoding="linear", gain=2.0)
    assert capture.views[1].colour == Colour(encoding="sony_slog3", gain=2.0, matrix=identity, matrix_space="encoded")
    assert "colour" not in capture.tags
    assert [colour_name(view) for view in capture.views[:2]] == ["linear, gain 2", "sony_slog3, a matrix, gain 2"]
    assert "colours: linear, gain 2 (4 views); sony_slog3, a matrix, gain 2 (1 views)" in str(
        check_capture(capture.root)
    )
    stored = cv2.imread(str(capture.views[0].image))[80, 60, ::-1] / 255
    found = pixels.read_view(capture.views[0], capture).rgb[80, 60]
    np.testing.assert_allclose(found, (2 * stored).clip(0, 1), atol=1e-3)


def test_written_colours_are_read_back(tmp_path: Path) -> None:
    colour = Colour(encoding="red_log3g10", matrix=((1, 0, 0, 0.5), (0, 1, 0, 0), (0, 0, 1, 0)), gain=0.5)
    view = synthetic_view("left/cam 0", camera())
    description = CaptureDescription(subject="s", expression="e", colours={"left/cam 0": colour})
    capture = native.read_capture(write_capture(tmp_path / "c", [replace(view, labels=None)], description))
    assert capture.views[0].colour == colour


def test_a_degraded_copy_is_srgb(tmp_path: Path) -> None:
    capture = described(make(tmp_path / "c"), '\n[colour]\nencoding = "linear"\n[colour.views.cam1]\ngain = 0.5\n')
    copy = native.read_capture(degrade.degrade(capture.root, tmp_path / "d", preset=degradation.PRESETS["none"]))
    assert all(view.colour == Colour() for view in copy.views)
    for before, after in zip(capture.views[:2], copy.views[:2], strict=True):
        expected = pixels.read_view(before, capture).rgb
        np.testing.assert_allclose(pixels.read_view(after, copy).rgb, expected, atol=1e-4)
    stored = cv2.imread(str(capture.views[0].image))[..., ::-1] / 255
    np.testing.assert_allclose(expected.mean(), 0.5 * stored.mean(), atol=0.02)


@pytest.mark.parametrize(
    "text, what, got",
    [
        ('encoding = "slog9"', "encoding of [colour] is unknown", "slog9"),
        ("encoding = 3", "encoding of [colour] is unknown", "3"),
        ("gain = 0", "gain of [colour] is malformed", "0"),
        ("gain = true", "gain of [colour] is malformed", "True"),
        ("matrix = [[1, 0], [0, 1]]", "matrix of [colour] is malformed", "[[1, 0]"),
        ("matrix = [[1, 0, 0], [0, 1, 0], [0, 0, 1, 2]]", "matrix of [colour] is malformed", "2"),
        ('matrix_space = "xyz"', "matrix_space of [colour] is unknown", "xyz"),
        ("gamma = 2.2", "[colour] has an unknown key", "gamma"),
        ("views = 3", "[colour.views] is malformed", "3"),
        ("views.cam9.gain = 2", "views that do not exist", "cam9"),
        ("views.cam1.gain = -2", "gain of [colour.views.cam1] is malformed", "-2"),
    ],
)
def test_malformed_colours_are_refused(tmp_path: Path, text: str, what: str, got: str) -> None:
    root = make(tmp_path / "c", drop=("normals", "labels", "mask"))
    path = root / "capture.toml"
    path.write_text(path.read_text().split("[segmentation]")[0])
    with pytest.raises(InputError) as caught:
        described(root, f"\n[colour]\n{text}\n")
    assert what in caught.value.what and got in str(caught.value.got), str(caught.value)
    path.write_text('colour = "red"\n' + path.read_text().split("[colour]")[0])
    with pytest.raises(InputError, match="malformed"):
        native.read_capture(root)


def test_16_bit_srgb_resolves_the_light_of_a_log_image(tmp_path: Path) -> None:
    codes = np.linspace(0.1, 0.6, WIDTH_PX * HEIGHT_PX).reshape(HEIGHT_PX, WIDTH_PX, 1).repeat(3, 2)
    stored = (codes * 65535).round().astype(np.uint16)
    cv2.imwrite(str(tmp_path / "a.png"), stored)
    expected = ENCODINGS["sony_slog3"].curve(stored / 65535).clip(0, 1)  # grey stays grey in any primaries
    found = light_of(tmp_path / "a.png", Colour(encoding="sony_slog3"))
    np.testing.assert_allclose(found, expected, atol=3e-5)
    assert np.abs(linear_to_srgb(found) - linear_to_srgb(expected)).max() < 1e-4
