"""Channels of a small head made from its photographs and 68 landmarks; they agree with the truth."""

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from registration.capture.native import read_capture
from registration.capture.pixels import read_view
from registration.completion.saved import completions_folder
from registration.errors import InputError
from registration.inputs import read_inputs
from registration.options import RegisterOptions
from registration.preparation import write_completed
from registration.types import ViewPixels
from tests.registration.register.conftest import RecordedProgress
from tests.registration.register.synthetic import MODEL, Truth, make

OPTIONS = RegisterOptions(recipe="preview", use_scan="never")
GIVEN = ("capture.toml", "sparse", "images", "landmarks", "scan.ply")


@pytest.fixture(scope="module")
def truth(tmp_path_factory) -> Truth:
    return make(tmp_path_factory.mktemp("completion") / "whole")


@pytest.fixture(scope="module")
def photographs(truth: Truth) -> Path:
    """The capture with images, cameras and landmarks alone."""
    root = truth.root.with_name("photographs")
    shutil.copytree(
        truth.root, root, ignore=lambda folder, names: {n for n in names if Path(folder) == truth.root} - {*GIVEN}
    )
    settings = root / "capture.toml"
    settings.write_text(settings.read_text("utf-8").split("[segmentation]")[0], "utf-8")
    return root


@pytest.fixture(scope="module", autouse=True)
def cache(tmp_path_factory):
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.mktemp("cache")))
        yield


@pytest.fixture(scope="module")
def completed(photographs: Path, cache) -> Path:
    out = photographs.with_name("completed")
    write_completed(photographs, MODEL, out, OPTIONS)
    return out


def views(root: Path) -> list[tuple[str, ViewPixels]]:
    capture = read_capture(root)
    return [(view.name, read_view(view, capture)) for view in capture.views]


def test_masks_agree_with_the_truth(completed, truth):
    """Where labels do not exclude what nothing tells, such as all around a head that fills its image."""
    (unlabelled,) = (k for k, name in enumerate(read_capture(completed).classes) if name.endswith("unlabelled"))
    shares = []
    for (name, made), (_, right) in zip(views(completed), views(truth.root), strict=True):
        known = ((made.mask > 0.99) | (made.mask < 0.01)) & (made.label_coverage[..., unlabelled] < 0.01)
        shares.append(known.mean())
        assert ((made.mask > 0.5) == (right.mask > 0.5))[known].mean() > 0.97, name
    assert np.median(shares) > 0.9 and min(shares) > 0.3


def test_depths_and_normals_agree_with_the_truth(completed, truth):
    degrees, shares = [], []
    for (_, made), (_, right) in zip(views(completed), views(truth.root), strict=True):
        both = made.normals.any(-1) & right.normals.any(-1) & (made.confidence > 0.2)
        cosine = (made.normals * right.normals).sum(-1)[both]
        degrees += np.degrees(np.arccos(cosine.clip(-1, 1))).tolist()
        shares.append(both.sum() / right.normals.any(-1).sum())
        assert ((made.depth > 0) <= (made.confidence > 0)).mean() > 0.999
    assert np.median(degrees) < 8 and np.mean(shares) > 0.3


def test_labels_agree_with_the_truth(completed, truth):
    made_capture, right_capture = read_capture(completed), read_capture(truth.root)
    agree, total = 0.0, 0.0
    for (_, made), (_, right) in zip(views(completed), views(truth.root), strict=True):
        made_skin = made.label_coverage[..., made_capture.classes.index("skin")] > 0.5
        right_skin = right.label_coverage[..., right_capture.classes.index("skin")] > 0.5
        agree, total = agree + (made_skin & right_skin).sum(), total + (made_skin | right_skin).sum()
    assert agree / total > 0.7


def test_what_the_capture_had_is_unchanged(completed, photographs):
    for name in ("images", "landmarks", "sparse", "scan.ply"):
        before, after = photographs / name, completed / name
        for file in before.rglob("*") if before.is_dir() else [before]:
            if file.is_file():
                assert (after / file.relative_to(before)).read_bytes() == file.read_bytes() if before.is_dir() else True


def test_the_copy_lacks_nothing_and_shows_what_was_made(completed):
    inputs = read_inputs(completed, MODEL, OPTIONS)
    assert inputs.plan.empty
    assert (completed / "made.jpg").stat().st_size > 10_000
    with pytest.raises(InputError, match="nothing to make"):
        write_completed(completed, MODEL, completed.with_name("again"), OPTIONS)


def test_the_same_inputs_are_made_once(completed, photographs, tmp_path):
    progress = RecordedProgress()
    made = write_completed(photographs, MODEL, tmp_path / "copy", OPTIONS, progress=progress)
    assert any("was made before" in note for note in progress.notes)
    assert made.figures["channels"] == ["masks", "labels", "normals"]
    other = replace(OPTIONS, recipe="draft")
    write_completed(photographs, MODEL, tmp_path / "draft", other, progress=progress)
    assert len(list(completions_folder().iterdir())) == 1


def test_cameras_that_see_no_common_side_give_no_depths_and_say_so(photographs, tmp_path):
    made = write_completed(photographs, MODEL, tmp_path / "two", replace(OPTIONS, views=2))
    assert any(note.startswith("no depths and normals could be made") for note in made.notes)
    assert made.figures["coverage"] == 0
    assert not (tmp_path / "two" / "depth").exists() and (tmp_path / "two" / "masks").is_dir()


def test_an_existing_folder_is_refused_before_any_work(completed, photographs):
    with pytest.raises(InputError, match="exists"):
        write_completed(photographs, MODEL, completed, OPTIONS)
