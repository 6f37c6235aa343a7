"""The GPU's benchmark: which packages it carries, and what becomes of parts that fail or take too long."""

import subprocess
import sys

import pytest

from bench.gpu import Part
from bench.support.offline_bundle import needed
from tests.conftest import ROOT

FOUND = [
    {"name": "Torch", "version": "2", "requires_dist": ["cuda-thing", "typing_extensions", "tool; extra == 'x'"]},
    {"name": "cuda-thing", "version": "13", "requires_dist": ["typing-extensions>=4"]},
    {"name": "typing_extensions", "version": "4"},
    {"name": "kornia", "version": "1", "requires_dist": ["torch>=2", "kornia_rs"]},
    {"name": "kornia-rs", "version": "3"},
]


def test_a_package_that_is_there_already_is_left_out_with_what_it_alone_needs():
    roots = ["kornia", "typing_extensions[all]"]
    assert needed(FOUND, roots, ["torch"]) == ["kornia-rs==3", "kornia==1", "typing_extensions==4"]
    assert len(needed(FOUND, roots, [])) == 5


@pytest.mark.parametrize(
    ("code", "seconds", "outcome"),
    [
        ("print('5 passed')", 60, "5 passed"),
        ("print('no device'); raise SystemExit(3)", 60, "failed (3): no device"),
        ("import time; time.sleep(60)", 0.5, "no time left"),
    ],
)
def test_a_part_says_how_it_ended(tmp_path, code, seconds, outcome):
    part = Part(name="a part", command=[sys.executable, "-c", code], figures=str.strip)
    part.run(tmp_path, seconds)
    assert outcome in part.outcome and part.seconds < 30


def test_nothing_is_measured_before_it_was_prepared(tmp_path):
    command = [sys.executable, "-m", "bench.gpu", str(tmp_path)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=60)
    assert done.returncode == 2 and "--prepare" in done.stderr
