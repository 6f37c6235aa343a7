"""One capture written in every format, by a writer made from the format's description, and read back."""

import importlib
from dataclasses import replace
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from registration.capture import native
from registration.formats.convert import import_capture
from registration.formats.registry import FORMATS, detect_format, read_source
from registration.formats.source import ReadOptions
from registration.types import Capture
from tests.registration.capture.small import DISTORTIONS, make

NAMES = [known.name for known in FORMATS]


@pytest.fixture(scope="module", params=[False, True], ids=["pinhole", "distorted"])
def original(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Capture:
    lens = DISTORTIONS["OPENCV"] if request.param else ()
    return native.read_capture(make(tmp_path_factory.mktemp("small") / "capture", distortion=lens))


def with_square_pixels(capture: Capture) -> Capture:
    """The capture with one focal length: its images only serve to be copied."""
    cameras = [replace(view.camera, intrinsics=view.camera.intrinsics.copy()) for view in capture.views]
    for camera in cameras:
        camera.intrinsics[1, 1] = camera.intrinsics[0, 0]
    views = [replace(view, camera=camera) for view, camera in zip(capture.views, cameras, strict=True)]
    return replace(capture, views=tuple(views))


def names(writer: ModuleType, capture: Capture) -> list[str]:
    """The names of views that a writer gives, which its format prescribes."""
    if getattr(writer, "NUMBERED", False):
        return [str(number) for number in range(len(capture.views))]
    return [getattr(writer, "PREFIX", "") + view.name for view in capture.views]


@pytest.mark.parametrize("name", NAMES)
def test_cameras_images_and_masks_survive(name: str, original: Capture, tmp_path: Path) -> None:
    writer = importlib.import_module(f"tests.fixtures.formats.{name}")  # each format needs one
    if original.views[0].camera.distortion and getattr(writer, "PINHOLES", False):
        pytest.skip(f"{name} has no lens model")
    if getattr(writer, "SQUARE_PIXELS", False):
        original = with_square_pixels(original)
    folder = tmp_path / "source"
    folder.mkdir()
    writer.write(original, folder)
    assert detect_format(folder).name == name
    source = read_source(folder, ReadOptions(subject="ball", expression="neutral"))
    import_capture(source, tmp_path / "native", unit_m=1.0 if source.unit_m is None else None)
    back = native.read_capture(tmp_path / "native")
    assert [view.name for view in back.views] == names(writer, original)
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
