"""Malformed inputs through the command line, under limits of time and memory: all are refused, nothing is written."""

import re
import subprocess
import sys

import pytest

from tests.conftest import ROOT


def run(*arguments: str) -> str:
    """Run the corpus; on a busy machine a case may take long by the clock, but not in processor time."""
    command = [sys.executable, "-m", "tests.fixtures.malformed", "--seconds", "90", *arguments]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout[-6000:] + done.stderr[-3000:]
    return done.stdout


def cases(output: str) -> int:
    return int(re.search(r"^(\d+) cases: \d+ refused$", output, re.MULTILINE)[1])


def test_a_sixteenth_of_the_malformed_inputs_is_refused():
    assert cases(run("--share", "1/16")) >= 60


@pytest.mark.slow
def test_all_malformed_inputs_are_refused():
    assert cases(run()) >= 1000
