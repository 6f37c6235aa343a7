"""`make setup`, with a stand-in for Python that records its calls: real ones would download gigabytes."""

import os
import shutil
import subprocess
from pathlib import Path

from tests.conftest import ROOT

FAKE = """#!/bin/sh
echo "$*" >> "{calls}"
case "$*" in
    *"-m venv"*) sleep 0.5; mkdir -p .venv/bin; cp "{python}" .venv/bin/python ;;
esac
"""


def test_two_setups_at_once_make_one_environment(tmp_path: Path) -> None:
    for name in ("Makefile", "pyproject.toml", "constraints.txt"):
        shutil.copy(ROOT / name, tmp_path / name)
    python, calls = tmp_path / "python", tmp_path / "calls.txt"
    python.write_text(FAKE.format(calls=calls, python=python))
    python.chmod(0o755)
    environment = {name: value for name, value in os.environ.items() if not name.startswith("MAKE")}
    command = ["make", "setup", f"PYTHON={python}"]
    pipe = subprocess.PIPE
    runs = [
        subprocess.Popen(command, cwd=tmp_path, env=environment, stdout=pipe, stderr=subprocess.STDOUT, text=True)
        for _ in range(2)
    ]
    outputs = [run.communicate(timeout=60)[0] for run in runs]
    assert [run.returncode for run in runs] == [0, 0], outputs
    made = [line for line in calls.read_text().splitlines() if "-m venv" in line]
    installed = [line for line in calls.read_text().splitlines() if "--editable" in line]
    assert len(made) == len(installed) == 1, calls.read_text()
    assert sum("waiting for it" in output for output in outputs) == 1
