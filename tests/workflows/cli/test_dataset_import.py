"""`gnmreg dataset import`: layouts of datasets, selections, failures that stop nothing, and repeated imports."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from registration.capture.native import read_capture
from registration.errors import InputError
from registration.formats.datasets import find_recordings
from tests.fixtures.formats import bare
from tests.registration.capture.small import make
from tests.registration.formats.projecting import image, video
from tests.registration.formats.test_head_datasets import AHEAD, RIGHT, K, facescape, multiface, vhap
from workflows.cli.app import main
from workflows.records.dataset import read_dataset
from workflows.records.dataset_import import DatasetImportRecord


def nersemble_dataset(root: Path) -> Path:
    """Two participants of NeRSemble 2 with two sequences each; one video of the second participant is damaged."""
    for participant in ("017", "018"):
        folder = root / participant
        (folder / "calibration").mkdir(parents=True)
        params = {"world_2_cam": {"42": AHEAD, "44": RIGHT}, "intrinsics": K}
        (folder / "calibration" / "camera_params.json").write_text(json.dumps(params))
        for sequence in ("EXP-1-head", "EMO-1-shout+laugh"):
            for serial in ("42", "44"):
                video(folder / "sequences" / sequence / "images" / f"cam_{serial}.mp4", 110, 160, frames=3)
    (root / "018" / "sequences" / "EMO-1-shout+laugh" / "images" / "cam_44.mp4").write_bytes(b"no video at all")
    return root


def names(root: Path) -> list[str]:
    return sorted(str(path.parent.relative_to(root)) for path in root.rglob("capture.toml"))


def test_a_failing_capture_is_named_and_stops_no_other(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    source, out = nersemble_dataset(tmp_path / "data"), tmp_path / "out"
    arguments = ["dataset", "import", str(source), str(out), "--neutral", "EXP-1-head"]
    assert main(arguments) == 1
    text = capsys.readouterr().out
    assert "failed: 018/EMO-1-shout+laugh: The video cannot be read" in text and "3 of 4 captures" in text
    assert names(out) == ["017/EMO-1-shout+laugh", "017/neutral", "018/neutral"]
    assert set(read_dataset(out).subjects) == {"017", "018"}
    before = (out / "017" / "neutral" / "import.json").stat().st_mtime_ns
    shutil.copy(
        source / "017" / "sequences" / "EMO-1-shout+laugh" / "images" / "cam_44.mp4",
        source / "018" / "sequences" / "EMO-1-shout+laugh" / "images" / "cam_44.mp4",
    )
    assert main(arguments) == 0  # only what failed is imported again
    assert (out / "017" / "neutral" / "import.json").stat().st_mtime_ns == before
    record = DatasetImportRecord.read(out / "import.json")
    assert [row.status for row in record.rows] == ["imported"] * 4 and not record.failed
    assert main([*arguments, "--unit", "mm"]) == 2
    assert "with other settings" in capsys.readouterr().err


def test_frames_subjects_and_expressions_are_selected(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    source, out = nersemble_dataset(tmp_path / "data"), tmp_path / "out"
    command = ["dataset", "import", str(source), str(out), "--subjects", "01*", "--expressions", "EXP-*"]
    assert main([*command, "--frames", "0,2", "--neutral", "EXP-1-head"]) == 0
    assert names(out) == ["017/EXP-1-head_00002", "017/neutral", "018/EXP-1-head_00002", "018/neutral"]
    capture = read_capture(out / "017" / "EXP-1-head_00002")
    assert (capture.subject, capture.expression) == ("017", "EXP-1-head_00002")
    assert main(["dataset", "import", str(source), str(tmp_path / "b"), "--subjects", "019"]) == 2
    assert "017, 018" in capsys.readouterr().err and not (tmp_path / "b").exists()
    assert main(["dataset", "import", str(source), str(tmp_path / "b"), "--frames", "0,first"]) == 2
    assert "0,30,60" in capsys.readouterr().err
    assert main(["dataset", "import", str(source), str(tmp_path / "b"), "--frames", "9", "--subjects", "017"]) == 2
    assert "There is no such frame" in capsys.readouterr().out  # of every capture: none is left


def test_each_layout_has_its_subjects_and_expressions(tmp_path: Path) -> None:
    def found(root: Path) -> list[tuple[str, str, str]]:
        return [(r.subject, r.expression, r.format) for r in find_recordings(root)]

    multiface(tmp_path / "multiface")
    segments = ("E001_Neutral_Eyes_Open", "E002_Swallow")
    assert found(tmp_path / "multiface") == [("6795937", segment, "multiface") for segment in segments]
    facescape(tmp_path / "facescape")
    assert found(tmp_path / "facescape") == [("212", "anger", "facescape")]
    vhap(tmp_path / "vhap" / "074_EMO-1_v16_DS4_whiteBg")
    vhap(tmp_path / "vhap" / "074_EXP-2_v16_DS4_whiteBg")
    assert found(tmp_path / "vhap") == [("074", "EMO-1", "vhap"), ("074", "EXP-2", "vhap")]
    capture = read_capture(make(tmp_path / "capture"))
    for name in ("anna/neutral", "anna/smile", "ben/neutral"):
        (tmp_path / "own" / name).mkdir(parents=True)
        bare.write(capture, tmp_path / "own" / name)
    expected = [("anna", "neutral", "bare"), ("anna", "smile", "bare"), ("ben", "neutral", "bare")]
    assert found(tmp_path / "own") == expected
    assert found(tmp_path / "own" / "anna") == expected[:2]


def test_the_neutral_is_found_by_its_name(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    source, out = multiface(tmp_path / "data").parent, tmp_path / "out"
    assert main(["dataset", "import", str(source), str(out)]) == 0
    assert names(out) == ["6795937/E002_Swallow", "6795937/neutral"]
    text = capsys.readouterr().out
    assert "no neutral" not in text and "tracked_mesh" in text
    np.testing.assert_allclose(read_capture(out / "6795937" / "neutral").views[0].camera.T_cam_world[2, 3], 1.0)
    vhap(tmp_path / "vhap" / "074_EMO-1")
    assert main(["dataset", "import", str(tmp_path / "vhap"), str(tmp_path / "none")]) == 0
    assert "074 has no neutral" in capsys.readouterr().out


def test_what_is_no_dataset_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such folder"):
        find_recordings(tmp_path / "nothing")
    image(tmp_path / "pictures" / "a.png", 8, 8)
    with pytest.raises(InputError, match="none"):
        find_recordings(tmp_path / "pictures")
    facescape(tmp_path / "twice")
    shutil.copytree(tmp_path / "twice" / "212" / "4_anger", tmp_path / "twice" / "212" / "5_anger")
    with pytest.raises(InputError, match="one recording of anger of 212"):
        find_recordings(tmp_path / "twice")
    with pytest.raises(InputError, match="recordings of vhap"):
        find_recordings(tmp_path / "twice", "vhap")
