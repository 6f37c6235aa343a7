"""Registrations that several tests share; each is computed once, some in a separate process."""

import shutil
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

from registration.options import RegisterOptions
from registration.pipeline import register
from registration.storage.registration_folder import load_registration
from registration.types import Registration
from tests.registration.register.synthetic import MODEL, Truth, make


class RecordedProgress:
    """A progress that records its calls."""

    def __init__(self) -> None:
        self.notes: list[str] = []
        self.stages: list[str] = []

    def message(self, text: str) -> None:
        self.notes.append(text)

    def update(self, done: int, total: int, label: str) -> None:
        assert 0 <= done <= total
        if label not in self.stages:
            self.stages.append(label)


@dataclass(frozen=True, kw_only=True)
class Run:
    """A computed registration."""

    truth: Truth
    out: Path
    result: Registration
    progress: RecordedProgress

    @property
    def error_mm(self) -> np.ndarray:
        """Distance of each vertex from the ground truth."""
        return 1e3 * np.linalg.norm(self.result.vertices - self.truth.vertices, axis=1)


class RegisterProcess:
    """`gnmreg register` in a separate process."""

    def __init__(self, truth: Truth, out: Path, *options: str):
        self.truth, self.out = truth, out
        command = [sys.executable, "-m", "workflows.cli", "register", str(truth.root), "--model", str(MODEL)]
        self._process = subprocess.Popen(
            [*command, "--out", str(out), *options], text=True, stdout=subprocess.PIPE, stderr=subprocess.PIPE
        )
        self._result: Run | None = None
        self.stdout = ""

    def run(self) -> Run:
        """Wait for the process; the messages are the lines of its log."""
        if self._result is None:
            self.stdout, log = self._process.communicate(timeout=600)
            assert self._process.returncode == 0, log
            progress = RecordedProgress()
            progress.notes = log.splitlines()
            self._result = Run(truth=self.truth, out=self.out, result=load_registration(self.out), progress=progress)
        return self._result

    def end(self) -> None:
        self._process.kill()
        self._process.communicate()


def run(truth: Truth, out: Path, options: RegisterOptions = RegisterOptions(), **settings) -> Run:  # noqa: B008
    progress = RecordedProgress()
    result = register(truth.root, MODEL, out, options, progress=progress, **settings)
    return Run(truth=truth, out=out, result=result, progress=progress)


@pytest.fixture(scope="session")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("register")


@pytest.fixture(scope="session")
def neutral(folder: Path) -> Truth:
    return make(folder / "neutral")


@pytest.fixture(scope="session")
def again_process(neutral: Truth, folder: Path) -> Iterator[RegisterProcess]:
    process = RegisterProcess(neutral, folder / "out" / "again")
    yield process
    process.end()


@pytest.fixture(scope="session")
def registered(neutral: Truth, again_process: RegisterProcess, folder: Path) -> Run:
    """The neutral with default options."""
    return run(neutral, folder / "out" / "neutral")


@pytest.fixture(scope="session")
def again(again_process: RegisterProcess) -> Run:
    """A repetition of the registration."""
    return again_process.run()


@pytest.fixture(scope="session")
def without_landmarks_process(neutral: Truth, folder: Path) -> Iterator[RegisterProcess]:
    root = folder / "without_landmarks"
    shutil.copytree(neutral.root, root, ignore=shutil.ignore_patterns("landmarks"))
    process = RegisterProcess(replace(neutral, root=root), folder / "out" / "without_landmarks")
    yield process
    process.end()


@pytest.fixture(scope="session")
def without_landmarks(without_landmarks_process: RegisterProcess) -> Run:
    """The neutral with its landmark files hidden."""
    return without_landmarks_process.run()


@pytest.fixture(scope="session")
def smile(registered: Run, again: Run, without_landmarks_process: RegisterProcess, folder: Path) -> Run:
    """Another expression of the subject, from its neutral."""
    return run(make(folder / "smile", "smile"), folder / "out" / "smile", neutral=registered.out)


@pytest.fixture(scope="session")
def deterministic(neutral: Truth, folder: Path) -> Iterator[list[RegisterProcess]]:
    """Two runs side by side with `--deterministic`, three views and another seed."""
    options = ("--views", "3", "--seed", "5", "--deterministic")
    pair = [RegisterProcess(neutral, folder / "out" / f"deterministic_{i}", *options) for i in range(2)]
    yield pair
    for process in pair:
        process.end()
