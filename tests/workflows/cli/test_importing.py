"""`gnmreg capture import` from the command line."""

from pathlib import Path

import pytest

from registration.capture import native
from tests.fixtures.formats import nerfstudio
from tests.registration.capture.small import make
from workflows.cli.app import main


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("small")
    target = root / "anna"
    target.mkdir()
    nerfstudio.write(native.read_capture(make(root / "capture")), target)
    return target


def test_import_detects_converts_and_tells(folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["capture", "import", str(folder), str(tmp_path / "out"), "--unit", "m", "--expression", "smile"]) == 0
    printed = capsys.readouterr().out
    assert "5 views from nerfstudio" in printed and f"gnmreg capture check {tmp_path / 'out'}" in printed
    capture = native.read_capture(tmp_path / "out")
    assert (capture.subject, capture.expression, len(capture.views)) == ("anna", "smile", 5)


def test_options_are_passed(folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["capture", "import", str(folder), str(tmp_path / "out"), "--format", "nerfstudio", "--subject", "ben"]
    assert main([*words, "--unit", "0.5"]) == 0
    assert "a unit of its world is 0.5 m" in capsys.readouterr().out
    assert native.read_capture(tmp_path / "out").subject == "ben"


@pytest.mark.parametrize(
    ("options", "text"),
    [
        ((), "--unit"),
        (("--unit", "parsec"), "no such unit"),
        (("--format", "collada"), "no such format"),
        (("--frame", "3"), "no frames"),
    ],
)
def test_what_cannot_be_done_stops_with_code_2(
    options: tuple[str, ...], text: str, folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["capture", "import", str(folder), str(tmp_path / "out"), *options]) == 2
    assert text in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_an_existing_target_is_refused_first(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["capture", "import", str(tmp_path / "none"), str(tmp_path)]) == 2
    assert "exists already" in capsys.readouterr().err
