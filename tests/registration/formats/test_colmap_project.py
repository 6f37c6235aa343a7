"""Where COLMAP projects have their models, images, masks and meshes; and projects that cannot be used."""

import shutil
from pathlib import Path

import numpy as np
import pytest

from registration.capture import native
from registration.errors import InputError
from registration.formats.colmap_project import FORMAT, read
from registration.formats.source import ReadOptions
from registration.storage.mesh import write_ply
from registration.types import Capture
from tests.fixtures.formats import colmap
from tests.registration.capture.binary_model import write_binary
from tests.registration.capture.small import make


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Capture:
    return native.read_capture(make(tmp_path_factory.mktemp("small") / "capture"))


@pytest.fixture
def project(capture: Capture, tmp_path: Path) -> Path:
    colmap.write(capture, tmp_path / "project")
    return tmp_path / "project"


def check(path: Path, capture: Capture) -> None:
    assert FORMAT.detect(path)
    source = read(path, ReadOptions())
    assert [view.name for view in source.views] == [view.name for view in capture.views]
    assert all(view.mask is not None for view in source.views)
    assert source.subject == "project"
    for view, expected in zip(source.views, capture.views, strict=True):
        np.testing.assert_allclose(view.T_cam_world, expected.camera.T_cam_world, atol=1e-12)


@pytest.mark.parametrize("place", ["", "sparse", "sparse/0"])
def test_the_model_or_its_folders_may_be_named(place: str, project: Path, capture: Capture) -> None:
    check(project / place, capture) if place != "sparse" else check(project, capture)


@pytest.mark.parametrize("place", ["sparse", "dense/sparse", "colmap/sparse/0"])
def test_places_of_the_model(place: str, project: Path, capture: Capture) -> None:
    model = shutil.move(project / "sparse" / "0", project / "model")
    shutil.rmtree(project / "sparse")
    shutil.copytree(model, project / place)
    shutil.rmtree(model)
    check(project, capture)


def test_binary_models(project: Path, capture: Capture) -> None:
    write_binary(project / "sparse" / "0", project / "binary")
    shutil.rmtree(project / "sparse" / "0")
    shutil.move(project / "binary", project / "sparse" / "0")
    check(project, capture)


@pytest.mark.parametrize("name", ["input", "photos", "rgb", "."])
def test_images_by_other_names(name: str, project: Path, capture: Capture) -> None:
    for image in (project / "images").iterdir():
        (project / name).mkdir(exist_ok=True)
        shutil.move(image, project / name / image.name)
    (project / "images").rmdir()
    check(project, capture)


def test_masks_with_the_suffix_replaced(project: Path, capture: Capture) -> None:
    for mask in (project / "masks").iterdir():
        mask.rename(mask.with_name(mask.name.replace(".png.png", ".png")))
    check(project, capture)


def test_an_undistorted_workspace(project: Path, capture: Capture) -> None:
    """`dense` has its own model and images, and a mesh; the project's own come first."""
    for folder in ("images", "masks"):
        shutil.copytree(project / folder, project / "dense" / folder)
    shutil.copytree(project / "sparse" / "0", project / "dense" / "sparse")
    write_ply(project / "dense" / "meshed-poisson.ply", np.eye(3), np.array([[0, 1, 2]]))
    write_ply(project / "dense" / "fused.ply", np.eye(3), np.zeros((0, 3), np.int64))
    source = read(project / "dense", ReadOptions(subject="anna", expression="smile"))
    assert source.scan == project / "dense" / "meshed-poisson.ply"
    assert source.views[0].image == project / "dense" / "images" / "cam0.png"
    assert (source.subject, source.expression) == ("anna", "smile")
    whole = read(project, ReadOptions())
    assert whole.views[0].image == project / "images" / "cam0.png"
    assert any("dense" in note for note in whole.notes)


def test_a_native_capture_is_none(capture: Capture) -> None:
    assert not FORMAT.detect(capture.root)


def test_several_models_are_refused_with_their_folders(project: Path) -> None:
    shutil.copytree(project / "sparse" / "0", project / "sparse" / "1")
    with pytest.raises(InputError, match="several COLMAP models") as caught:
        read(project, ReadOptions())
    assert str(project / "sparse" / "0") in caught.value.fix
    assert len(read(project / "sparse" / "1", ReadOptions()).views) == 5


def replace_in(file: Path, old: str, new: str) -> None:
    text = file.read_text()
    assert old in text
    file.write_text(text.replace(old, new, 1))


def test_missing_images_are_named(project: Path) -> None:
    (project / "images" / "cam3.png").unlink()
    with pytest.raises(InputError, match="image of the COLMAP model is missing") as caught:
        read(project, ReadOptions())
    assert "cam3.png" in caught.value.expected and "4 of 5" in caught.value.got
    shutil.rmtree(project / "images")
    shutil.rmtree(project / "masks")
    with pytest.raises(InputError, match="image of the COLMAP model is missing") as caught:
        read(project, ReadOptions())
    assert "none of the 5" in caught.value.got


def test_a_model_without_images_or_none_at_all(project: Path, tmp_path: Path) -> None:
    (project / "sparse" / "0" / "images.txt").write_text("# nothing\n")
    with pytest.raises(InputError, match="no images"):
        read(project, ReadOptions())
    with pytest.raises(InputError, match="no COLMAP model"):
        read(tmp_path, ReadOptions())


@pytest.mark.parametrize(
    ("old", "new", "what"),
    [
        ("PINHOLE 120 160", "EQUIRECTANGULAR 120 160", "cannot be read"),
        ("1 PINHOLE", "1 FOV", "cannot be read"),
        ("1 PINHOLE 120 160 240", "1 PINHOLE 120 160 -240", "singular"),
        ("1 PINHOLE 120 160 240", "1 PINHOLE 120 160 nan", "singular"),
        ("1 PINHOLE 120", "1 PINHOLE 0", "out of range"),
        ("1 PINHOLE", "9 PINHOLE", "has no camera"),
    ],
)
def test_bad_cameras_are_refused(old: str, new: str, what: str, project: Path) -> None:
    replace_in(project / "sparse" / "0" / "cameras.txt", old, new)
    with pytest.raises(InputError, match=what):
        read(project, ReadOptions())


def test_panoramas_are_refused_with_what_to_do(project: Path) -> None:
    cameras = project / "sparse" / "0" / "cameras.txt"
    lines = cameras.read_text().splitlines()
    cameras.write_text("\n".join([lines[0], "1 EQUIRECTANGULAR 120 160 120 160", *lines[2:]]))
    with pytest.raises(InputError, match="not one of a lens") as caught:
        read(project, ReadOptions())
    assert "panorama_sfm.py" in caught.value.fix
