"""One capture written in every format, by a writer made from the format's description, and read back."""

from pathlib import Path

import numpy as np
import pytest

from registration.capture import native, pixels
from registration.formats import native_source
from registration.formats.convert import import_capture
from registration.formats.source import ReadOptions
from registration.types import Capture
from tests.registration.capture.small import DISTORTIONS, make
from tests.registration.formats.writers import (
    NAMES,
    with_square_pixels,
    writer_of,
    written_and_imported,
    written_names,
)


@pytest.fixture(scope="module", params=[False, True], ids=["pinhole", "distorted"])
def original(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Capture:
    lens = DISTORTIONS["OPENCV"] if request.param else ()
    return native.read_capture(make(tmp_path_factory.mktemp("small") / "capture", distortion=lens))


@pytest.mark.parametrize("name", NAMES)
def test_cameras_images_and_masks_survive(name: str, original: Capture, tmp_path: Path) -> None:
    writer = writer_of(name)
    if original.views[0].camera.distortion and getattr(writer, "PINHOLES", False):
        pytest.skip(f"{name} has no lens model")
    if getattr(writer, "SQUARE_PIXELS", False):
        original = with_square_pixels(original)
    back = written_and_imported(name, original, tmp_path)
    assert [view.name for view in back.views] == written_names(writer, original)
    for view, expected in zip(back.views, original.views, strict=True):
        ours, theirs = view.camera, expected.camera
        assert (ours.width_px, ours.height_px) == (theirs.width_px, theirs.height_px)
        np.testing.assert_allclose(ours.intrinsics, theirs.intrinsics, rtol=1e-6, atol=1e-6)
        np.testing.assert_allclose(ours.T_cam_world, theirs.T_cam_world, rtol=0, atol=1e-6)
        padded = [(*lens, *[0.0] * (8 - len(lens))) for lens in (ours.distortion, theirs.distortion)]
        np.testing.assert_allclose(*padded, rtol=1e-6, atol=1e-12)
        assert view.image.read_bytes() == expected.image.read_bytes()
        if not getattr(writer, "MASKS", True):
            continue
        assert view.mask is not None and expected.mask is not None
        assert view.mask.read_bytes() == expected.mask.read_bytes()


def test_labels_and_colours_of_a_native_capture_are_imported(tmp_path: Path) -> None:
    """Label maps of a table are written as indices of the classes, colours as [colour]."""
    root = make(tmp_path / "source", drop=("landmarks",))
    path = root / "capture.toml"
    text = path.read_text().split("[segmentation]")[0]
    path.write_text(
        text + '[segmentation]\ntable = "lapa"\n[colour]\nencoding = "linear"\n[colour.views.cam1]\ngain = 0.5\n'
    )
    before = native.read_capture(root)
    import_capture(native_source.read(root, ReadOptions()), tmp_path / "copy")
    after = native.read_capture(tmp_path / "copy")
    assert after.classes == before.classes and [v.colour for v in after.views] == [v.colour for v in before.views]
    for old, new in zip(before.views, after.views, strict=True):
        np.testing.assert_array_equal(
            pixels.read_view(new, after).label_coverage, pixels.read_view(old, before).label_coverage
        )
