"""Limits that keep the code readable: files of at most 400 lines, functions of at most eight parameters."""

import ast
from collections.abc import Iterator
from pathlib import Path

from tests.conftest import ROOT

MAX_LINES = 400
MAX_PARAMETERS = 8  # more travel in an options object
# Signatures that a library prescribes.
PRESCRIBED = {"bench/support/stock_renderer.py:sample"}  # mitsuba.Integrator.sample


def sources(*folders: str) -> Iterator[tuple[str, str]]:
    for folder in folders:
        for file in sorted((ROOT / folder).rglob("*.py")):
            yield str(file.relative_to(ROOT)), file.read_text("utf-8")


def test_no_file_is_long():
    files = sources("registration", "coregister", "workflows", "bench", "docs", "tests")
    assert {file: count for file, text in files if (count := text.count("\n")) > MAX_LINES} == {}


def test_no_function_has_many_parameters():
    many = {}
    for file, text in sources("registration", "coregister", "workflows", "bench", "docs"):
        for node in ast.walk(ast.parse(text)):
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
                names = [a.arg for a in (*node.args.posonlyargs, *node.args.args, *node.args.kwonlyargs)]
                count = len(names) - (names[:1] in (["self"], ["cls"]))
                if count > MAX_PARAMETERS:
                    many[f"{file}:{node.name}"] = count
    assert many.keys() - PRESCRIBED == set(), many


def test_no_module_has_the_name_of_another_in_its_package():
    """A file `x.py` beside a folder `x` would hide one of them."""
    packages = [ROOT / name for name in ("registration", "coregister", "workflows", "bench")]
    twins = [file for package in packages for file in package.rglob("*.py") if file.with_suffix("").is_dir()]
    assert twins == []


def test_every_room_says_what_it_is_for():
    silent = []
    for package in ("registration", "coregister", "workflows"):
        for folder in [ROOT / package, *(ROOT / package).iterdir()]:
            if folder.is_dir() and list(folder.glob("*.py")):
                init = folder / "__init__.py"
                if not init.is_file() or not ast.get_docstring(ast.parse(init.read_text("utf-8"))):
                    silent.append(str(Path(folder).relative_to(ROOT)))
    assert silent == []
