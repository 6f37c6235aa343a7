"""Registrations that several tests look at; each is made once."""

import shutil
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from registration.register import register
from registration.types import Registration
from tests.register.synthetic import MODEL, Truth, make


class Notes:
    """A progress that keeps what it is told."""

    def __init__(self) -> None:
        self.notes: list[str] = []
        self.stages: list[str] = []

    def note(self, text: str) -> None:
        self.notes.append(text)

    def at(self, done: int, total: int, what: str) -> None:
        assert 0 <= done <= total
        if what not in self.stages:
            self.stages.append(what)


@dataclass(frozen=True, kw_only=True)
class Run:
    """A registration that was made, and what was heard of it."""

    truth: Truth
    out: Path
    result: Registration
    progress: Notes

    @property
    def error_mm(self) -> np.ndarray:
        """Distance of each vertex from the true one."""
        return 1e3 * np.linalg.norm(self.result.vertices - self.truth.vertices, axis=1)


def run(truth: Truth, out: Path, **options) -> Run:
    progress = Notes()
    result = register(truth.root, model_path=MODEL, out=out, progress=progress, **options)
    return Run(truth=truth, out=out, result=result, progress=progress)


@pytest.fixture(scope="session")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("register")


@pytest.fixture(scope="session")
def neutral(folder: Path) -> Truth:
    return make(folder / "neutral")


@pytest.fixture(scope="session")
def registered(neutral: Truth, folder: Path) -> Run:
    """The neutral, as anyone would register it."""
    return run(neutral, folder / "out" / "neutral")


@pytest.fixture(scope="session")
def again(neutral: Truth, folder: Path) -> Run:
    """The same once more."""
    return run(neutral, folder / "out" / "again")


@pytest.fixture(scope="session")
def smile(registered: Run, folder: Path) -> Run:
    """Another expression of the subject, from its neutral."""
    return run(make(folder / "smile", "smile"), folder / "out" / "smile", neutral=registered.out)


@pytest.fixture(scope="session")
def without_landmarks(neutral: Truth, folder: Path) -> Run:
    """The neutral with its landmark files hidden."""
    root = folder / "without_landmarks"
    shutil.copytree(neutral.root, root, ignore=shutil.ignore_patterns("landmarks"))
    hidden = Truth(**{**vars(neutral), "root": root})
    return run(hidden, folder / "out" / "without_landmarks")


@pytest.fixture(scope="session")
def deterministic(neutral: Truth, folder: Path) -> list[tuple[Path, "subprocess.CompletedProcess[str]"]]:
    """Two runs of the command side by side, with `--deterministic`, three views and another seed."""
    outs = [folder / "out" / f"deterministic_{i}" for i in range(2)]
    command = [sys.executable, "-m", "workflows.cli", "register", str(neutral.root), "--model", str(MODEL)]
    options = ["--views", "3", "--seed", "5", "--deterministic"]
    running = [
        subprocess.Popen(
            [*command, *options, "--out", str(out)], text=True, stdout=subprocess.PIPE, stderr=subprocess.PIPE
        )
        for out in outs
    ]
    ended = []
    for out, process in zip(outs, running, strict=True):
        stdout, stderr = process.communicate(timeout=600)
        ended.append((out, subprocess.CompletedProcess(process.args, process.returncode, stdout, stderr)))
    return ended
