"""Help texts and the table of commands are complete and import nothing heavy."""

import importlib
import inspect
import re
import subprocess
import sys
from dataclasses import fields
from pathlib import Path
from typing import get_args

import pytest

import workflows.cli
from registration.fit.recipes import RECIPES
from registration.options import RegisterOptions
from workflows.cli.app import COMMANDS, main
from workflows.cli.farm import QueueName
from workflows.cli.options import JobOptions
from workflows.engine.jobs import GPU, REBUILD

CLI = Path(workflows.cli.__file__).parent
HEAVY = {"torch", "mitsuba", "drjit", "numpy", "scipy", "cv2", "pycolmap", "trimesh", "matplotlib", "viser"}
HEAVY |= {"dbos", "sqlalchemy", "jinja2"}


@pytest.mark.parametrize("command", ["", "capture", "dataset", "model", "store", *COMMANDS])
def test_every_command_explains_itself(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        main([*command.split(), "--help"])
    assert stop.value.code == 0
    assert f"usage: gnmreg {command}".strip() in capsys.readouterr().out


@pytest.mark.parametrize("command", COMMANDS)
def test_help_explains_every_option_where_it_is_shown(
    command: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "120")  # wider ones have two columns of long help
    with pytest.raises(SystemExit):
        main([*command.split(), "--help"])
    text = re.sub(r"[│ ]*\n[│ ] {10,}(?=\w)", " ", capsys.readouterr().out)  # help below a long option
    rows = re.findall(r"^[│ ]{2,}((?:--?[a-z]|[A-Z]+ ).*)$", text, re.MULTILINE)
    assert len(rows) > 1
    assert all(re.search(r"[a-z] [a-z]", row) for row in rows), rows  # words, not only a name and a default
    assert not re.search(r"(?i)\bas for\b|default: \)", text)


def test_the_overview_lists_every_command_once_in_its_group(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(["-h"])
    text = capsys.readouterr().out
    listed = re.findall(r"^  (\w+(?: \w+)?)  +\S", text, re.MULTILINE)
    assert listed == [*COMMANDS]
    assert re.findall(r"^([A-Z][a-z]+)$", text, re.MULTILINE) == ["Capture", "Register", "Model", "Farm"]


def test_every_function_of_the_command_modules_is_a_command() -> None:
    modules = [importlib.import_module(f"workflows.cli.{path.stem}") for path in CLI.glob("[!_]*.py")]
    public = {
        function
        for module in modules
        if module.__name__.rpartition(".")[2] not in ("app", "arguments", "options", "remote")
        for name, function in inspect.getmembers(module, inspect.isfunction)
        if function.__module__ == module.__name__ and not name.startswith("_")
    }
    assert public == {*COMMANDS.values()}


def test_summaries_fit_into_the_overview() -> None:
    summaries = {name: (inspect.getdoc(command) or "").splitlines()[0] for name, command in COMMANDS.items()}
    assert {name: text for name, text in summaries.items() if not 20 < len(text) <= 80} == {}


@pytest.mark.parametrize("words", ["registr", "capture synht", "capture"])
def test_unknown_commands_list_the_available_commands(words: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        main(words.split())
    error = capsys.readouterr().err
    assert stop.value.code == 2
    assert "capture synth" in error and ("similar: " in error) == (words != "capture")


def test_the_help_lists_the_existing_recipes_and_queues(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "300")
    for command in ("register", "subject", "batch", "coregister"):
        with pytest.raises(SystemExit):
            main([command, "--help"])
        row = re.search(r"--recipe.*?--views", capsys.readouterr().out, re.DOTALL)
        assert row and all(f"{name}: " in row[0] for name in RECIPES)
    assert set(get_args(QueueName)) == {GPU, REBUILD}


@pytest.mark.parametrize("command", ["", "register", "coregister", "worker"])
def test_help_imports_nothing_heavy(command: str) -> None:
    code = """
import sys
from workflows.cli.app import main
try:
    main([*sys.argv[1:], "--help"])
finally:
    print("MODULES", *sys.modules, file=sys.stderr)
"""
    run = subprocess.run([sys.executable, "-c", code, *command.split()], capture_output=True, text=True, check=True)
    assert "usage: gnmreg" in run.stdout
    assert HEAVY.isdisjoint(run.stderr.split("MODULES")[1].split())


def test_every_register_option_is_offered_by_all_commands_that_register(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "300")
    named = {"camera_sigma_px": "--camera-sigma", "detect": "--no-detect", "stereo": "--no-stereo"}
    options = {named.get(item.name, f"--{item.name.replace('_', '-')}") for item in fields(RegisterOptions)}
    options -= {"--landmark-files"}
    for command in ("register", "subject", "batch", "coregister"):
        with pytest.raises(SystemExit):
            main([command, "--help"])
        text = capsys.readouterr().out
        assert options <= set(re.findall(r"--[a-z-]+", text))
        assert ("--landmarks" in text) == (command in ("register", "subject"))  # jobs cannot name files


def test_job_options_convert_to_register_options() -> None:
    options = JobOptions(recipe="studio", views=7, seed=3, deterministic=True, variant="cuda").register_options()
    assert type(options) is RegisterOptions  # input hashes contain the type's name
    assert options == RegisterOptions(recipe="studio", views=7, seed=3, deterministic=True, variant="cuda")
