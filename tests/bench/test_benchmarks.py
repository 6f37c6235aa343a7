"""Every benchmark starts as `python -m bench.NAME`, and the quickest run a tiny case to the end."""

import ast
import subprocess
import sys

import pytest

from tests.conftest import ROOT, SHARED, needs_shared

NAMES = sorted(file.stem for file in (ROOT / "bench").glob("*.py") if file.stem != "__init__")
GNM = SHARED / "data" / "gnm"


def run(name: str, *arguments: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", f"bench.{name}", *arguments]
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=300)


# Each in a process of its own, forked from one that has imported what takes seconds.
HELP_OF_ALL = """
import contextlib, os, runpy, sys
import cv2, scipy.optimize, scipy.sparse.linalg, torch
from pathlib import Path

out, *names = sys.argv[1:]
for name in names:
    if os.fork() == 0:
        sys.argv = [f"{name}.py", "--help"]
        with (Path(out) / name).open("w") as file, contextlib.redirect_stdout(file), contextlib.redirect_stderr(file):
            try:
                runpy.run_module(f"bench.{name}", run_name="__main__", alter_sys=True)
                code = 1
            except SystemExit as stop:
                code = stop.code or 0
            except BaseException as error:
                code = print(repr(error)) or 1
            sys.stdout.flush()
        os._exit(code)
    if os.waitstatus_to_exitcode(os.wait()[1]):
        print(name, (Path(out) / name).read_text()[-500:])
"""


def test_every_benchmark_starts(tmp_path):
    assert len(NAMES) >= 14
    command = [sys.executable, "-c", HELP_OF_ALL, str(tmp_path), *NAMES]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=300)
    assert (done.returncode, done.stdout) == (0, ""), done.stderr[-2000:]
    texts = {name: (tmp_path / name).read_text("utf-8") for name in NAMES}
    assert [name for name, text in texts.items() if f"python -m bench.{name}" not in text] == []


def test_no_module_has_the_name_of_a_standard_library_module_and_no_benchmark_imports_tests():
    files = [file for folder in ("bench", "tests") for file in (ROOT / folder).rglob("*.py")]
    assert [str(file) for file in files if file.stem in sys.stdlib_module_names] == []
    imported = {
        node.module or ""
        for file in (ROOT / "bench").rglob("*.py")
        for node in ast.walk(ast.parse(file.read_text("utf-8")))
        if isinstance(node, ast.ImportFrom)
    }
    assert {module for module in imported if module.split(".")[0] == "tests"} == set()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "arguments", "figure"),
    [
        ("farm_queue", ("--captures", "5", "--seconds", "1", "--settle", "0"), "complete, 2 workers"),
        ("landmark_fit", ("--only", "schur", "--count", "2"), "2 of 2 limits kept"),
        ("model_building", ("--neutrals", "6", "--expressions", "8"), "peak_gb"),
        ("renderer", ("--case", "2x48", "--stock"), "stock 2x256"),
        ("service", ("--captures", "60", "--requests", "2", "--viewers", "3", "--seconds", "2"), "0 lost of"),
        ("sampler", ("--only", "collapse", "--count", "400", "--steps", "60"), "status: collapsed"),
    ],
)
def test_a_tiny_case_runs_to_its_figures(name, arguments, figure):
    done = run(name, *arguments)
    assert done.returncode == 0, done.stderr[-2000:]
    assert figure in done.stdout


@pytest.mark.slow
def test_model_table_compares_the_first_model(tmp_path):
    sizes = ("--people", "2", "--points", "300", "--adam-steps", "20", "--random-heads", "2", "--jobs", "1")
    done = run("model_table", "--out", str(tmp_path), *sizes, "--curve-samples", "0")
    assert done.returncode == 0, done.stderr[-2000:]
    assert "gnm_head_first, stage2: mean" in done.stdout and "region nose" in done.stdout


@needs_shared
def test_without_identity_writes_a_model(tmp_path):
    out = tmp_path / "model.npz"
    files = (GNM / "gnm_head_reconstructed.npz", GNM / "gnm_real_samples.npz", out)
    done = run("without_identity", *map(str, files))
    assert done.returncode == 0, done.stderr[-2000:]
    assert out.is_file()


@pytest.mark.slow
@needs_shared
def test_cases_are_tried_and_judged():
    done = run("cases", str(SHARED / "cases"), str(SHARED / "data" / "captures" / "ict_pop_00" / "neutral"), "one_view")
    assert done.returncode == 0, done.stderr[-2000:]
    assert "one_view: refused, green" in done.stdout
