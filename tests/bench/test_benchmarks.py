"""Every benchmark starts as `python -m bench.NAME`, and the quickest run a tiny case to the end."""

import ast
import os
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor

import pytest

from tests.conftest import ROOT, SHARED, needs_shared

NAMES = sorted(file.stem for file in (ROOT / "bench").glob("*.py") if file.stem != "__init__")
GNM = SHARED / "data" / "gnm"


def run(name: str, *arguments: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", f"bench.{name}", *arguments]
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=300)


def test_every_benchmark_starts():
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        runs = dict(zip(NAMES, pool.map(lambda name: run(name, "--help"), NAMES), strict=True))
    assert len(runs) >= 14
    assert {name: done.stderr[-500:] for name, done in runs.items() if done.returncode} == {}
    assert [name for name, done in runs.items() if f"python -m bench.{name}" not in done.stdout] == []


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


@pytest.mark.parametrize(
    ("name", "arguments", "figure"),
    [
        ("farm_queue", ("--captures", "5", "--seconds", "1", "--settle", "0"), "complete, 2 workers"),
        ("landmark_fit", ("--only", "schur", "--count", "2"), "2 of 2 limits kept"),
        ("model_building", ("--samples", "60", "--components", "5"), "peak_gb"),
        ("renderer", ("--case", "2x48", "--stock"), "stock 2x256"),
        ("sampler", ("--only", "collapse", "--count", "400", "--steps", "60"), "status: collapsed"),
    ],
)
def test_a_tiny_case_runs_to_its_figures(name, arguments, figure):
    done = run(name, *arguments)
    assert done.returncode == 0, done.stderr[-2000:]
    assert figure in done.stdout


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


@needs_shared
def test_cases_are_tried_and_judged():
    done = run("cases", str(SHARED / "cases"), str(SHARED / "data" / "captures" / "ict_pop_00" / "neutral"), "one_view")
    assert done.returncode == 0, done.stderr[-2000:]
    assert "one_view: refused, green" in done.stdout
