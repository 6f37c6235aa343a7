"""Commands hand their arguments to the library once, and report bad input without a traceback."""

from pathlib import Path
from types import SimpleNamespace

import cv2
import pytest

import workflows.steps.subject
from registration import pipeline
from registration.options import RegisterOptions
from tests.conftest import FIXTURES
from tests.registration.capture.small import make
from workflows.cli import app
from workflows.cli.app import main
from workflows.records.subject import CaptureRow, SubjectRecord

TINY_MODEL = FIXTURES / "tiny_gnm.npz"


@pytest.mark.parametrize(
    "arguments",
    ["", "register", "register CAPTURE --model M", "subject S --model M", "capture", "register C --views x"],
)
def test_wrong_arguments_stop_with_code_2(arguments: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        main(arguments.split())
    assert stop.value.code == 2
    assert "gnmreg" in capsys.readouterr().err


@pytest.mark.parametrize("pair", ["68", "68=", "=file.txt"])
def test_input_errors_are_printed_without_a_traceback(
    pair: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    assert main(["register", str(tmp_path), "--model", "m.npz", "--out", str(out), "--landmarks", pair]) == 2
    error = capsys.readouterr().err
    assert "SCHEME=FILE" in error and pair in error and "fix:" in error
    assert "Traceback" not in error
    assert not out.exists()


@pytest.mark.parametrize(
    "flags, what",
    [
        ("--views 0", "number of cameras"),
        ("--size 480 20000", "image size"),
        ("--size 0 10", "image size"),
        ("--views 500 --size 8000 8000", "too many pixels"),
        ("--seed -1", "seed"),
        ("--expression grin", "no such expression"),
        ("--target nose", "NAME=WEIGHT"),
        ("--target nose/nose-hump-incr=much", "NAME=WEIGHT"),
        ("--target nose/nose-hump-incr=nan", "weight is out of range"),
    ],
)
def test_bad_studio_settings_are_refused_before_any_work(
    flags: str, what: str, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "empty"))
    monkeypatch.setenv("PIP_NO_INDEX", "1")  # neither model nor population is available: they must not be needed
    assert main(["capture", "synth", str(tmp_path / "capture"), *flags.split()]) == 2
    error = capsys.readouterr().err
    assert what in error and "fix:" in error and "Traceback" not in error
    assert list(tmp_path.iterdir()) == []


def test_a_synthetic_capture_does_not_overwrite_a_folder(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "mine").write_text("mine")
    assert main(["capture", "synth", str(tmp_path)]) == 2
    assert "exists already" in capsys.readouterr().err
    assert (tmp_path / "mine").read_text() == "mine"


def test_a_seed_is_a_number(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        main(["capture", "synth", str(tmp_path / "capture"), "--seed", "abc"])
    assert stop.value.code == 2
    assert "--seed" in capsys.readouterr().err


def test_model_info_prints_and_draws(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    image = tmp_path / "model.png"
    assert main(["model", "info", str(TINY_MODEL), "--out", str(image)]) == 0
    assert "vertices" in capsys.readouterr().out
    assert image.read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize(
    "command",
    [
        "capture check {missing} --out {out}",
        "capture calibrate {missing} --model {missing} --out {out}",
        "model info {missing} --out {out}",
        "evaluate {missing} --capture {missing}",
    ],
)
def test_missing_input_is_refused_and_nothing_is_written(
    command: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    missing, out = tmp_path / "missing", tmp_path / "out.png"
    arguments = command.format(missing=missing, out=out).split()
    assert main(arguments) == 2
    error = capsys.readouterr().err
    assert str(missing) in error and "fix:" in error
    assert list(tmp_path.iterdir()) == []


def test_missing_capture_of_a_registration(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    missing, out = tmp_path / "missing", tmp_path / "out"
    assert main(["register", str(missing), "--model", str(TINY_MODEL), "--out", str(out)]) == 2
    error = capsys.readouterr().err
    assert "The capture folder is missing" in error and str(missing) in error and "fix:" in error
    assert "Traceback" not in error
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("command", ["register {capture}", "subject {subject}"])
def test_unknown_recipes_stop_with_code_2(command: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    capture, out = make(tmp_path / "subject" / "neutral"), tmp_path / "out"
    words = command.format(capture=capture, subject=capture.parent).split()
    assert main([*words, "--model", str(TINY_MODEL), "--out", str(out), "--recipe", "drafty"]) == 2
    error = capsys.readouterr().err
    assert "drafty" in error and "draft" in error and "studio" in error and "Traceback" not in error
    assert not out.exists()


def test_capture_check_prints_and_draws(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    capture, sheet = make(tmp_path / "capture"), tmp_path / "sheet.png"
    assert main(["capture", "check", str(capture), "--out", str(sheet)]) == 0
    text = capsys.readouterr().out
    assert "5 views, all checks passed" in text and str(sheet) in text
    assert sheet.read_bytes().startswith(b"\x89PNG")


def test_capture_check_mends_and_draws_at_once(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    capture, mended = make(tmp_path / "capture"), tmp_path / "mended"
    for mask in (capture / "masks").iterdir():
        cv2.imwrite(str(mask), 255 - cv2.imread(str(mask), cv2.IMREAD_UNCHANGED))
    rig, sheet = tmp_path / "rig.png", tmp_path / "sheet.png"
    words = ["capture", "check", str(capture), "--explain", str(rig), "--out", str(sheet)]
    assert main(words) == 2 and rig.is_file() and not sheet.exists()
    assert "sheet.png was not drawn" in capsys.readouterr().err
    rig.unlink()
    assert main([*words, "--fix", str(mended)]) == 0
    assert rig.is_file() and sheet.is_file() and (mended / "doctor.txt").is_file()


def test_capture_degrade_applies_the_faults(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    source, target = make(tmp_path / "source"), tmp_path / "target"
    flags = ["--preset", "none", "--seed", "4", "--break", "cam3=shifted", "cam1=black", "cam3=exposure"]
    assert main(["capture", "degrade", str(source), str(target), *flags]) == 0
    assert capsys.readouterr().out == f"{target}\n"
    assert main(["capture", "check", str(target)]) == 0
    assert "preset none, seed 4; cam1 black; cam3 exposure shifted" in capsys.readouterr().out


@pytest.mark.parametrize("pair", ["cam03", "cam03=", "=black"])
def test_malformed_faults_are_refused(pair: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["capture", "degrade", str(tmp_path / "source"), str(tmp_path / "target"), "--break", pair]) == 2
    error = capsys.readouterr().err
    assert "VIEW=FAULT" in error and pair in error and "fix:" in error and "Traceback" not in error


def test_an_option_given_twice_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    flags = ["--seed", "3", "--seed=4"]
    assert main(["capture", "degrade", str(tmp_path / "source"), str(tmp_path / "target"), *flags]) == 2
    error = capsys.readouterr().err
    assert "more than once" in error and "--seed" in error and "fix:" in error


def test_unknown_presets_stop_with_code_2(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    source = make(tmp_path / "source")
    with pytest.raises(SystemExit) as stop:
        main(["capture", "degrade", str(source), str(tmp_path / "target"), "--preset", "studioo"])
    assert stop.value.code == 2
    error = capsys.readouterr().err
    assert "studioo" in error and "harsh" in error
    assert list(tmp_path.iterdir()) == [source]


@pytest.mark.parametrize("status, code", [("converged", 0), ("stopped", 0), ("failed", 1)])
def test_register_passes_every_argument(
    status: str, code: int, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The library's own work is tested in tests/registration/register; here only arguments, output and exit code."""
    received = {}

    def record(capture: Path, model: Path, out: Path, options: RegisterOptions, **settings) -> SimpleNamespace:
        received.update(settings, capture=capture, model=model, out=out, options=options)
        return SimpleNamespace(status=status, reason="because", figures={})

    monkeypatch.setattr(pipeline, "register", record)
    flags = "--recipe studio --views 7 --seed 3 --neutral N --deterministic --force --variant cuda --landmarks 68=a 5=b"
    assert main(["register", "C", "--model", "M.npz", "--out", "O", *flags.split()]) == code
    received.pop("progress").message("a message")
    assert received == {
        "capture": Path("C"),
        "model": Path("M.npz"),
        "out": Path("O"),
        "neutral": Path("N"),
        "force": True,
        "options": RegisterOptions(
            recipe="studio",
            views=7,
            seed=3,
            deterministic=True,
            variant="cuda",
            landmark_files={"68": Path("a"), "5": Path("b")},
        ),
    }
    printed = capsys.readouterr()
    assert printed.out == f"{status}: because\nO\n"
    assert "a message" in printed.err


@pytest.mark.parametrize(
    ("statuses", "code"),
    [
        (("converged", "stopped"), 0),
        (("stopped", "failed"), 1),
        (("converged", "error"), 1),
        (("failed", "skipped"), 2),
        (("error", "skipped"), 2),
    ],
)
def test_subject_passes_every_argument(
    statuses: tuple, code: int, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The loop itself is tested in test_subject.py."""
    received = {}

    def record(subject: Path, model: Path, out: Path, options: RegisterOptions, **settings) -> SubjectRecord:
        received.update(settings, subject=subject, model=model, out=out, options=options)
        rows = tuple(
            CaptureRow(name=f"c{i}", expression="", status=s, reason="because") for i, s in enumerate(statuses)
        )
        return SubjectRecord(subject="anna", model="ab", recipe="draft", neutral="c0", rows=rows)

    monkeypatch.setattr(workflows.steps.subject, "register_subject", record)
    flags = "--recipe studio --views 7 --seed 3 --neutral N --deterministic --force --variant cuda --landmarks 68=a 5=b"
    assert main(["subject", "S", "--model", "M.npz", "--out", "O", *flags.split()]) == code
    received.pop("progress").message("a message")
    assert received == {
        "subject": Path("S"),
        "model": Path("M.npz"),
        "out": Path("O"),
        "neutral": "N",
        "force": True,
        "options": RegisterOptions(
            recipe="studio",
            views=7,
            seed=3,
            deterministic=True,
            variant="cuda",
            landmark_files={"68": Path("a"), "5": Path("b")},
        ),
    }
    printed = capsys.readouterr()
    assert printed.out == f"c0: {statuses[0]}: because\nc1: {statuses[1]}: because\nO/index.html\n"
    assert "a message" in printed.err


def test_missing_subject(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    missing, out = tmp_path / "missing", tmp_path / "out"
    assert main(["subject", str(missing), "--model", str(TINY_MODEL), "--out", str(out)]) == 2
    error = capsys.readouterr().err
    assert "The subject's folder is missing" in error and str(missing) in error and "fix:" in error
    assert "Traceback" not in error
    assert list(tmp_path.iterdir()) == []


def test_an_interrupt_is_reported_without_a_traceback(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def interrupt(*args, **options) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(workflows.steps.subject, "register_subject", interrupt)
    assert main(["subject", "S", "--model", "M", "--out", "O"]) == 130
    assert capsys.readouterr().err == "interrupted\n"


def test_the_traceback_of_a_bug_shows_no_password_and_no_escape_sequence(capsys: pytest.CaptureFixture[str]) -> None:
    try:
        raise RuntimeError("no \x1b[2J at postgresql://me:a/canary@h/d or s3://AKIA:canary@b")
    except RuntimeError as error:
        app.print_unexpected(type(error), error, error.__traceback__)
    text = capsys.readouterr().err
    assert "Traceback" in text and r"\x1b[2J" in text and "canary" not in text and "\x1b" not in text
