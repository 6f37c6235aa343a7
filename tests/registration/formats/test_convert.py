"""What an import writes, decides and refuses, whatever the format."""

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from registration.capture import native
from registration.capture.scan import read_scan
from registration.doctor.validation import validate_capture
from registration.errors import InputError
from registration.formats.convert import import_capture
from registration.formats.native_source import read
from registration.formats.source import Distortion, ReadOptions, SourceCapture, SourceView, VideoFrame
from registration.formats.units import parse_unit
from registration.types import Camera
from tests.registration.capture.small import make


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make(tmp_path_factory.mktemp("small") / "capture")


@pytest.fixture
def source(folder: Path) -> SourceCapture:
    return read(folder, ReadOptions())


def in_unit(source: SourceCapture, unit_m: float | None, factor: float) -> SourceCapture:
    """The source as a format without a unit gives it, its lengths multiplied."""
    views = []
    for view in source.views:
        T = view.T_cam_world.copy()
        T[:3, 3] *= factor
        views.append(replace(view, T_cam_world=T))
    return replace(source, views=tuple(views), unit_m=unit_m, scan=None)


def test_the_result_is_a_valid_capture_with_a_record(source: SourceCapture, tmp_path: Path) -> None:
    done = import_capture(source, tmp_path / "native")
    capture = native.read_capture(done.root)
    validate_capture(capture)
    assert (capture.subject, capture.expression, capture.classes) == ("ball", "neutral", source.classes)
    assert capture.tags == source.tags
    assert capture.scan is not None and capture.scan.read_bytes() == (source.scan or Path()).read_bytes()
    record = json.loads((done.root / "import.json").read_text())
    assert record["format"] == "native" and record["unit_m"] == 1
    assert record["views"]["cam0"] == {
        "image": "images/cam0.png",
        "mask": "masks/cam0.png",
        "normals": "normals/cam0.png",
        "segmentation": "segmentation/cam0.png",
    }
    assert done.notes == tuple(record["notes"]) and "ground_truth.npz" in done.notes[0]


def test_nothing_is_written_where_something_is(source: SourceCapture, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="exists already"):
        import_capture(source, tmp_path)


def damaged_image(view: SourceView, tmp_path: Path) -> SourceView:
    file = tmp_path / "damaged.png"
    content = Path(str(view.image)).read_bytes()
    file.write_bytes(content[: len(content) // 2])
    return replace(view, image=file)


def half_size(view: SourceView, tmp_path: Path) -> SourceView:
    return replace(view, width_px=view.width_px // 2, height_px=view.height_px // 2)


def other_mask(view: SourceView, tmp_path: Path) -> SourceView:
    cv2.imwrite(str(tmp_path / "mask.png"), np.zeros((5, 5), np.uint8))
    return replace(view, mask=tmp_path / "mask.png")


def posed(edit: Callable[[np.ndarray], None]) -> Callable[[SourceView, Path], SourceView]:
    def damage(view: SourceView, tmp_path: Path) -> SourceView:
        T = view.T_cam_world.copy()
        edit(T)
        return replace(view, T_cam_world=T)

    return damage


def mirror(T: np.ndarray) -> None:
    T[0, :3] *= -1


def stretch(T: np.ndarray) -> None:
    T[:3, :3] *= 1.01


def lose(T: np.ndarray) -> None:
    T[0, 3] = np.nan


BAD = {
    "damaged image": (damaged_image, "truncated", ""),
    "half size": (half_size, "size is not the camera's", "by 2"),
    "other mask": (other_mask, "mask's size", ""),
    "mirrored": (posed(mirror), "mirrored", ""),
    "stretched": (posed(stretch), "not rigid", ""),
    "not finite": (posed(lose), "not finite", ""),
    "outside": (lambda view, _: replace(view, name="../a"), "cannot be named", ""),
    "repeated": (lambda view, _: replace(view, name="cam0"), "cannot be named", ""),
    "no focal": (lambda view, _: replace(view, intrinsics=np.diag([0.0, 1, 1])), "singular", ""),
    "unknown lens": (lambda view, _: replace(view, distortion=Distortion(model="x")), "lens", ""),
    "missing": (lambda view, tmp: replace(view, image=tmp / "none.png"), "missing", ""),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_views_are_refused_and_nothing_is_written(name: str, source: SourceCapture, tmp_path: Path) -> None:
    damage, what, fix = BAD[name]
    views = (*source.views[:-1], damage(source.views[-1], tmp_path))
    with pytest.raises(InputError, match=what) as caught:
        import_capture(replace(source, views=views), tmp_path / "out" / "native")
    assert fix in caught.value.fix
    assert not (tmp_path / "out").exists() or not any((tmp_path / "out").iterdir())


def test_damage_that_only_decoding_finds_leaves_nothing(source: SourceCapture, tmp_path: Path) -> None:
    file = tmp_path / "damaged.png"
    content = bytearray(Path(str(source.views[-1].image)).read_bytes())
    content[len(content) // 2] ^= 0xFF
    file.write_bytes(content)
    fisheye = Distortion(model="opencv_fisheye", coefficients=(0.1,))
    views = (*source.views[:-1], replace(source.views[-1], image=file, distortion=fisheye))
    with pytest.raises(InputError, match="cannot be decoded"):
        import_capture(replace(source, views=views), tmp_path / "out" / "native")
    assert not any((tmp_path / "out").iterdir())


@pytest.mark.parametrize(("factor", "name"), [(1.0, "m"), (100.0, "cm"), (1000.0, "mm")])
def test_the_unit_is_estimated_from_the_eyes(factor: float, name: str, source: SourceCapture, tmp_path: Path) -> None:
    done = import_capture(in_unit(source, None, factor), tmp_path / "native")
    assert done.unit_m == parse_unit(name)
    assert any(f"taken for {name}: " in note for note in done.notes)
    for view, expected in zip(native.read_capture(done.root).views, source.views, strict=True):
        np.testing.assert_allclose(view.camera.T_cam_world, expected.T_cam_world, atol=1e-12)


def test_an_arbitrary_scale_is_estimated_and_named(source: SourceCapture, tmp_path: Path) -> None:
    done = import_capture(in_unit(source, None, 7.3), tmp_path / "native")
    assert abs(done.unit_m * 7.3 - 1) < 0.01  # the ball's eyes are 9 cm apart
    assert any("scale of its own" in note for note in done.notes)


def test_an_unknown_unit_is_refused_with_the_flag(source: SourceCapture, tmp_path: Path) -> None:
    bare = in_unit(source, None, 1000.0)
    bare = replace(bare, format="colmap", views=tuple(replace(view, landmarks={}) for view in bare.views))
    with pytest.raises(InputError, match="unit") as caught:
        import_capture(bare, tmp_path / "native")
    assert "--unit" in caught.value.fix
    assert import_capture(bare, tmp_path / "native", unit_m=parse_unit("mm")).unit_m == 1e-3


def test_the_users_unit_counts_before_the_formats(source: SourceCapture, tmp_path: Path) -> None:
    done = import_capture(source, tmp_path / "native", unit_m=0.5)
    assert any("--unit was followed" in note for note in done.notes)
    scan = native.read_capture(done.root).scan
    assert scan is not None and source.scan is not None
    np.testing.assert_allclose(read_scan(scan).vertices, 0.5 * read_scan(source.scan).vertices, atol=1e-7)


@pytest.mark.parametrize("name", ["m", "cm", "mm"])
def test_masks_or_a_scan_tell_the_unit_of_a_physical_world(name: str, source: SourceCapture, tmp_path: Path) -> None:
    scaled = in_unit(source, None, 1 / parse_unit(name))
    scaled = replace(scaled, format="bare", views=tuple(replace(view, landmarks={}) for view in scaled.views))
    done = import_capture(scaled, tmp_path / "native")
    assert done.unit_m == parse_unit(name)
    assert any("what the masks show would be 0.1" in note for note in done.notes)  # the ball's 18 cm
    with pytest.raises(InputError, match="unit"):  # of any scale
        import_capture(replace(scaled, format="colmap"), tmp_path / "other")


def test_a_scan_tells_the_unit(source: SourceCapture, tmp_path: Path) -> None:
    views = tuple(replace(view, landmarks={}, mask=None) for view in source.views)
    done = import_capture(replace(source, unit_m=None, format="bare", views=views), tmp_path / "native")
    assert done.unit_m == 1 and any("the scan would be 0.18 m" in note for note in done.notes)


@pytest.mark.parametrize("unit", ["", "parsec", "-1", "0", "nan", "inf"])
def test_units_that_are_none(unit: str) -> None:
    with pytest.raises(InputError, match="no such unit"):
        parse_unit(unit)


def jpeg(view: SourceView, tmp_path: Path, orientation: int, turn: bool) -> SourceView:
    """The view with a JPEG whose EXIF orientation is this; `turn`: the calibration is that of turned pixels."""
    size = (view.height_px, view.width_px) if turn else (view.width_px, view.height_px)
    image = Image.fromarray(np.random.default_rng(0).integers(0, 255, (size[1], size[0], 3), np.uint8))
    exif = image.getexif()
    exif[0x0112] = orientation
    image.save(tmp_path / "a.jpg", exif=exif)
    return replace(view, image=tmp_path / "a.jpg")


def test_an_image_of_stored_pixels_is_copied(source: SourceCapture, tmp_path: Path) -> None:
    view = jpeg(source.views[0], tmp_path, 6, turn=False)
    done = import_capture(replace(source, views=(view, *source.views[1:])), tmp_path / "native")
    assert (done.root / "images" / "cam0.jpg").read_bytes() == (tmp_path / "a.jpg").read_bytes()
    assert not any("orientation" in note for note in done.notes)


def test_an_image_of_turned_pixels_is_turned(source: SourceCapture, tmp_path: Path) -> None:
    view = jpeg(source.views[0], tmp_path, 6, turn=True)
    done = import_capture(replace(source, views=(view, *source.views[1:])), tmp_path / "native")
    stored = cv2.imread(str(tmp_path / "a.jpg"), cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
    written = cv2.imread(str(done.root / "images" / "cam0.png"))
    np.testing.assert_array_equal(written, cv2.rotate(stored, cv2.ROTATE_90_CLOCKWISE))
    assert any("cam0: turned" in note for note in done.notes)


def test_an_orientation_that_no_size_tells_is_named(source: SourceCapture, tmp_path: Path) -> None:
    view = jpeg(source.views[0], tmp_path, 3, turn=False)
    done = import_capture(replace(source, views=(view, *source.views[1:])), tmp_path / "native")
    assert any("cam0" in note and "orientation 3" in note for note in done.notes)


def test_a_frame_of_a_video(source: SourceCapture, tmp_path: Path) -> None:
    view = source.views[0]
    file = tmp_path / "a.avi"
    writer = cv2.VideoWriter(str(file), cv2.VideoWriter.fourcc(*"MJPG"), 25, (view.width_px, view.height_px))
    for grey in (30, 90, 150, 210):
        writer.write(np.full((view.height_px, view.width_px, 3), grey, np.uint8))
    writer.release()
    views = (replace(view, image=VideoFrame(file=file, index=2)), *source.views[1:])
    done = import_capture(replace(source, views=views), tmp_path / "native")
    assert abs(float(cv2.imread(str(done.root / "images" / "cam0.png")).mean()) - 150) < 4
    assert json.loads((done.root / "import.json").read_text())["views"]["cam0"]["frame"] == 2
    beyond = (replace(view, image=VideoFrame(file=file, index=9)), *source.views[1:])
    with pytest.raises(InputError, match="video frame cannot be read") as caught:
        import_capture(replace(source, views=beyond), tmp_path / "other")
    assert "4 frames" in caught.value.got and not (tmp_path / "other").exists()


def test_a_lens_of_few_coefficients_is_padded(source: SourceCapture, tmp_path: Path) -> None:
    lens = Distortion(model="opencv", coefficients=(0.1,))
    views = tuple(replace(view, distortion=lens) for view in source.views)
    done = import_capture(replace(source, views=views), tmp_path / "native")
    camera: Camera = native.read_capture(done.root).views[0].camera
    assert camera.distortion == (0.1, 0.0, 0.0, 0.0)


def test_masks_of_other_suffixes_become_png(source: SourceCapture, tmp_path: Path) -> None:
    view = source.views[0]
    assert view.mask is not None
    cv2.imwrite(str(tmp_path / "mask.bmp"), cv2.imread(str(view.mask), cv2.IMREAD_GRAYSCALE))
    views = (replace(view, mask=tmp_path / "mask.bmp"), *source.views[1:])
    done = import_capture(replace(source, views=views), tmp_path / "native")
    np.testing.assert_array_equal(
        cv2.imread(str(done.root / "masks" / "cam0.png"), cv2.IMREAD_UNCHANGED),
        cv2.imread(str(view.mask), cv2.IMREAD_UNCHANGED),
    )


def test_links_are_followed_and_folders_refused(source: SourceCapture, tmp_path: Path) -> None:
    view = source.views[0]
    (tmp_path / "link.png").symlink_to(Path(str(view.image)))
    done = import_capture(
        replace(source, views=(replace(view, image=tmp_path / "link.png"), *source.views[1:])), tmp_path / "n"
    )
    assert (done.root / "images" / "cam0.png").is_file() and not (done.root / "images" / "cam0.png").is_symlink()
    shutil.rmtree(done.root)
    (tmp_path / "folder.ply").mkdir()
    with pytest.raises(InputError, match="cannot be read"):
        import_capture(replace(source, scan=tmp_path / "folder.ply"), tmp_path / "n")
