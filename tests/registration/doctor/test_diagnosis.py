"""Spoiled captures are named rightly and mended, good ones pass (a part of `bench/doctor.py`)."""

import re
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from bench.doctor import unlike
from bench.support.spoiled_captures import SPOILED, Spoiled, make, remove
from registration.capture.native import read_capture
from registration.doctor.diagnosis import diagnose
from registration.doctor.mending import RECORD, mend_capture
from registration.doctor.rig_picture import draw_rig
from registration.errors import InputError
from registration.inputs import validate_capture
from tests.conftest import needs_shared
from tests.registration.capture import small
from tests.registration.doctor import faulty
from workflows.cli import __main__ as program

QUICK = (
    "nerfstudio, images and masks",
    "transposed, images and scan",
    "world in centimetres",
    "size in the model filled in",
    "K of half the size",
    "all turned by a quarter",
    "two views overexposed",
    "left and right landmarks exchanged",
    "folders mask and labels",
    "three faults at once",
)


def case(name: str) -> Spoiled:
    (found,) = (spoiled for spoiled in SPOILED if spoiled.name == name)
    return found


def test_there_are_many_cases_of_all_kinds() -> None:
    assert len({spoiled.name for spoiled in SPOILED}) == len(SPOILED) >= 36
    assert len({kind for spoiled in SPOILED for kind in spoiled.kinds}) >= 25


@needs_shared
@pytest.mark.parametrize("name", QUICK)
def test_a_spoiled_capture_is_named_and_mended(tmp_path: Path, name: str) -> None:
    spoiled = case(name)
    root, good, out = tmp_path / "spoiled", tmp_path / "good", tmp_path / "mended"
    make(faulty.SOURCE, root, spoiled)
    before = {path: path.read_bytes() for path in sorted(root.rglob("*")) if path.is_file()}
    diagnosis = diagnose(root)
    assert {finding.kind for finding in diagnosis.findings} == set(spoiled.kinds)
    assert re.search(spoiled.says, " ".join(finding.line for finding in diagnosis.findings), re.DOTALL)
    mended = mend_capture(root, out)
    assert {path: path.read_bytes() for path in sorted(root.rglob("*")) if path.is_file()} == before
    if spoiled.mended == "person":
        assert mended.out is None and not out.exists()
        return
    assert mended.usable and mended.left.findings == ()
    make(faulty.SOURCE, good, Spoiled(name="", kinds=(), says="", spoil=lambda _: None, without=spoiled.without))
    assert unlike(good, out, turned=spoiled.mended == "turned") == []
    record = (out / RECORD).read_text("utf-8")
    assert all(finding.kind in record for finding in mended.done) and "Nothing is left to do" in record


def test_a_registration_refuses_with_the_first_error_and_its_mend(tmp_path: Path) -> None:
    root = small.make(tmp_path / "capture", drop=("normals", "labels"))
    remove(root, ("scan.ply", "ground_truth.npz"))
    case("OpenGL").spoil(root)
    with pytest.raises(InputError) as caught:
        validate_capture(read_capture(root))
    assert all((caught.value.what, caught.value.where, caught.value.expected, caught.value.got))
    assert "--fix" in caught.value.fix and "diag(1, -1, -1)" in caught.value.fix


def test_exit_codes_and_pictures_of_the_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    root = small.make(tmp_path / "capture")
    picture = tmp_path / "rig.png"
    assert program.main(["capture", "check", str(root), "--explain", str(picture)]) == 0
    with Image.open(picture) as image:
        assert image.width == 1200 and len(np.unique(np.asarray(image).reshape(-1, 3), axis=0)) > 50
    assert program.main(["capture", "check", str(root), "--fix", str(tmp_path / "none")]) == 0
    assert "Nothing is wrong" in capsys.readouterr().out and not (tmp_path / "none").exists()
    case("inverted masks").spoil(root)
    case("OpenGL").spoil(root)
    assert program.main(["capture", "check", str(root)]) == 2
    said = capsys.readouterr().err
    assert "The mask is inverted" in said and "The cameras do not look at one subject" in said
    assert program.main(["capture", "check", str(root), "--fix", str(tmp_path / "mended")]) == 0
    assert program.main(["capture", "check", str(tmp_path / "mended")]) == 0
    assert program.main(["capture", "check", str(root), "--fix", str(tmp_path / "mended")]) == 2  # it exists


def test_what_cannot_be_read_is_a_picture_of_words(tmp_path: Path) -> None:
    root = small.make(tmp_path / "capture")
    (root / "sparse" / "images.txt").write_text("nonsense\n")
    diagnosis = diagnose(root)
    assert [finding.kind for finding in diagnosis.findings] == ["calibration"] and diagnosis.ledger is None
    draw_rig(diagnosis, tmp_path / "rig.png")
    with Image.open(tmp_path / "rig.png") as image:
        assert image.height < 400
