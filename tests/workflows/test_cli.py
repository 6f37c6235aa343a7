import subprocess
import sys
from pathlib import Path

import pytest

from workflows.cli import main

TINY_MODEL = Path(__file__).parents[1] / "fixtures" / "tiny_gnm.npz"
HEAVY = {"torch", "mitsuba", "drjit", "numpy", "scipy", "cv2", "pycolmap", "kornia", "trimesh", "matplotlib"}


@pytest.mark.parametrize(
    "command", ["", "register", "evaluate", "capture", "capture check", "model", "model info", "model fetch"]
)
def test_every_command_explains_itself(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        main([*command.split(), "--help"])
    assert stop.value.code == 0
    assert f"usage: gnmreg {command}".strip() in capsys.readouterr().out


def test_help_imports_nothing_heavy() -> None:
    code = """
import sys
from workflows.cli import main
try:
    main(["register", "--help"])
finally:
    print("MODULES", *sys.modules, file=sys.stderr)
"""
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert "--deterministic" in run.stdout
    assert HEAVY.isdisjoint(run.stderr.split("MODULES")[1].split())


@pytest.mark.parametrize("arguments", ["", "register", "register CAPTURE --model M", "capture", "register C --views x"])
def test_wrong_arguments_stop_with_code_2(arguments: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        main(arguments.split())
    assert stop.value.code == 2
    assert "gnmreg" in capsys.readouterr().err


@pytest.mark.parametrize("pair", ["68", "68=", "=file.txt"])
def test_input_error_is_told_without_a_traceback(pair: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "out"
    assert main(["register", str(tmp_path), "--model", "m.npz", "--out", str(out), "--landmarks", pair]) == 2
    error = capsys.readouterr().err
    assert "SCHEME=FILE" in error and pair in error and "fix:" in error
    assert "Traceback" not in error
    assert not out.exists()


def test_model_info_tells_and_draws(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    picture = tmp_path / "model.png"
    assert main(["model", "info", str(TINY_MODEL), "--out", str(picture)]) == 0
    assert "vertices" in capsys.readouterr().out
    assert picture.read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize(
    "command",
    [
        "capture check {missing} --out {out}",
        "model info {missing} --out {out}",
        "evaluate {missing} --capture {missing}",
    ],
)
def test_missing_input_is_told_and_nothing_is_written(
    command: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    missing, out = tmp_path / "missing", tmp_path / "out.png"
    arguments = command.format(missing=missing, out=out).split()
    assert main(arguments) == 2
    error = capsys.readouterr().err
    assert str(missing) in error and "fix:" in error
    assert list(tmp_path.iterdir()) == []
