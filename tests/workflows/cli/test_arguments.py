"""Repeated options, completion in a real shell, the version, output that nobody reads."""

import os
import re
import shutil
import subprocess
import sys
from importlib.metadata import version
from pathlib import Path

import pytest

from registration.errors import InputError
from tests.conftest import ROOT
from workflows.cli.app import COMMANDS, main
from workflows.cli.arguments import completion, merge_repeated_options, options_of


@pytest.mark.parametrize(
    ("command", "words", "merged"),
    [
        ("worker", "--root A B --gpu 0", "--root A B --gpu 0"),
        ("worker", "--root A --gpu 0 --root B", "--gpu 0 --root A B"),
        ("worker", "--root=A --root=B C", "--root A B C"),
        ("capture degrade", "SOURCE --break a=black TARGET --break=b=black", "SOURCE --break a=black TARGET b=black"),
        ("coregister", "D --components 5 --components 10 20", "D --components 5 10 20"),
    ],
)
def test_options_of_several_values_may_be_repeated(command: str, words: str, merged: str) -> None:
    assert merge_repeated_options(words.split(), COMMANDS[command]) == merged.split()


@pytest.mark.parametrize("words", ["--gpu 0 --gpu 1", "--folder A --folder=A", "--root A --db x --db y"])
def test_options_of_one_value_may_not_be_repeated(words: str) -> None:
    with pytest.raises(InputError, match="more than once"):
        merge_repeated_options(words.split(), COMMANDS["worker"])


@pytest.mark.parametrize("command", COMMANDS)
def test_the_options_are_those_of_the_help(
    command: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "120")  # wider ones have two columns of long help
    with pytest.raises(SystemExit):
        main([*command.split(), "--help"])
    listed = re.findall(r"^\W+(?:-h, )?(--[a-z][a-z-]*)", capsys.readouterr().out, re.MULTILINE)
    options = options_of(COMMANDS[command])
    assert sorted(listed) == sorted(options) and all(option.summary for option in options.values())


@pytest.mark.parametrize(
    ("typed", "words"),
    [
        ("gnmreg st", "stabilize status stereo store"),
        ("gnmreg capture ", "import calibrate check complete detect synth degrade"),
        ("gnmreg stabilize r", "review"),
        ("gnmreg status --wa", "--watch"),
        ("gnmreg stabilize review --po", "--port"),
        ("gnmreg register --variant ", "llvm cuda"),
        ("gnmreg --ver", "--version"),
    ],
)
def test_bash_completes(typed: str, words: str, tmp_path: Path) -> None:
    (tmp_path / "completion").write_text(completion("bash", COMMANDS))
    parts = typed.split(" ")
    array = " ".join(f"'{part}'" for part in parts)
    script = f"source {tmp_path}/completion; COMP_WORDS=({array}); COMP_CWORD={len(parts) - 1}; _gnmreg"
    run = subprocess.run(["bash", "-c", f'{script}; echo "${{COMPREPLY[*]}}"'], capture_output=True, text=True)
    assert run.stdout.split() == words.split() and not run.stderr


@pytest.mark.parametrize("shell", ["zsh", "fish"])
def test_other_shells_can_read_their_completion(shell: str, tmp_path: Path) -> None:
    text = completion(shell, COMMANDS)
    assert all(word in text for word in ("capture", "review", "watch", "llvm cuda"))
    if shutil.which(shell):
        (tmp_path / "completion").write_text(text)
        assert not subprocess.run([shell, "-n", str(tmp_path / "completion")], capture_output=True).stderr


def test_an_unknown_shell_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--print-completion", "tcsh"]) == 2
    assert "bash or zsh or fish" in capsys.readouterr().err


def test_the_version_is_printed(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        main(["--version"])
    assert stop.value.code == 0
    assert capsys.readouterr().out == f"gnmreg {version('gnm-registration')}\n"


@pytest.mark.parametrize(
    ("words", "first"),
    [
        ("statsu", "status"),
        ("capture chek X", "capture check"),
        ("captrue check X", "capture check"),
        ("check X", "capture check"),
        ("store-verify X", "store verify"),
        ("bootstrap", "model bootstrap"),
    ],
)
def test_the_nearest_command_is_named_first(words: str, first: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        main(words.split())
    assert stop.value.code == 2
    assert f"similar: {first}" in capsys.readouterr().err.splitlines()[0]


@pytest.mark.parametrize("words", ["--help", "status --help", "--print-completion bash"])
def test_output_that_nobody_reads_is_no_error(words: str) -> None:
    reading, writing = os.pipe()
    os.close(reading)
    command = [sys.executable, "-m", "workflows.cli", *words.split()]
    run = subprocess.run(command, cwd=ROOT, stdout=writing, stderr=subprocess.PIPE, text=True)
    os.close(writing)
    assert run.stderr == ""
