"""A subject's folder of small captures, and a stand-in for `register`."""

import json
import shutil
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pytest
import trimesh

import workflows.steps.subject
from registration.storage.registration_folder import save_registration
from registration.types import Registration
from tests.registration.capture import small
from tests.registration.register import synthetic
from tests.registration.report.test_page import a_registration
from tests.workflows.farm.databases import farm, postgres  # noqa: F401  fixtures

MODEL = synthetic.MODEL


@pytest.fixture(scope="session")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A capture with a scan but no truth: measuring drift takes a second."""
    folder = small.make(tmp_path_factory.mktemp("ball") / "ball")
    (folder / "ground_truth.npz").unlink()
    return folder


@pytest.fixture
def subject(capture: Path, tmp_path: Path) -> Path:
    """A folder of four captures and of entries that are not captures."""
    folder = tmp_path / "subject"
    for name, expression in (("rest", "neutral"), ("jaw10", "jaw"), ("jaw2", "jaw"), ("smile", "smile")):
        add(capture, folder / name, expression)
    add(capture, folder / ".rest.tmp", "neutral")
    (folder / "notes").mkdir()
    (folder / "notes.txt").write_text("none")
    return folder


def add(capture: Path, folder: Path, expression: str, subject: str = "ball") -> None:
    shutil.copytree(capture, folder)
    change(folder, '"neutral"', f'"{expression}"')
    change(folder, '"ball"', f'"{subject}"')


def add_truths(subject: Path, *names: str) -> None:
    """Write the same true points to each capture."""
    for name in names:
        np.savez(subject / name / "ground_truth.npz", vertices=small.landmarks_68())


def change(folder: Path, old: str, new: str) -> None:
    file = folder / "capture.toml"
    text = file.read_text()
    assert old in text
    file.write_text(text.replace(old, new))


class FakeRegister:
    """Stand-in for `register`: writes the true ball, translated by a millimetre for an expression."""

    def __init__(self) -> None:
        self.outcomes: dict[str, str | BaseException] = {}  # capture -> a status, or what is raised
        self.calls: list[tuple[str, Path, Path | None]] = []  # capture, out, neutral
        self.settings: list[Mapping[str, object]] = []
        self.records: list[list[tuple[str, str]]] = []  # subject.json's rows at each call

    def __call__(self, capture_path: Path, *, out: Path, neutral: Path | None, progress, **settings) -> Registration:
        self.calls.append((capture_path.name, out, neutral))
        self.settings.append(settings)
        self.records.append(statuses(out.parent))
        progress.update(1, 2, "fitting")
        outcome = self.outcomes.get(capture_path.name, "converged")
        if isinstance(outcome, BaseException):
            raise outcome
        ball = trimesh.creation.icosphere(subdivisions=3, radius=small.RADIUS_M)
        vertices = np.array(ball.vertices + (0 if neutral is None else (1e-3, 0, 0)), np.float32)
        result = a_registration(
            status=outcome,
            reason=f"it is {outcome}",
            vertices=vertices,
            offsets=np.zeros_like(vertices),
            confidence=np.ones(len(vertices), np.float32),
            triangles=np.array(ball.faces, np.int32),
            corner_uvs=np.zeros((len(ball.faces), 3, 2), np.float32),
            figures={"scan_to_mesh": {"face": {"mean_mm": 0.25, "median_mm": 0.125}}},
        )
        save_registration(result, out, "<html></html>")
        return result

    @property
    def order(self) -> list[str]:
        return [name for name, _, _ in self.calls]


@pytest.fixture
def fake(monkeypatch: pytest.MonkeyPatch) -> FakeRegister:
    fake = FakeRegister()
    monkeypatch.setattr(workflows.steps.subject, "register", fake)
    return fake


class RecordingProgress:
    """A progress that records its messages and labels."""

    def __init__(self) -> None:
        self.messages: list[str] = []
        self.steps: list[str] = []

    def message(self, text: str) -> None:
        self.messages.append(text)

    def update(self, done: int, total: int, label: str) -> None:
        self.steps.append(label)


def manifest(out: Path) -> dict:
    return json.loads((out / "subject.json").read_text())


def statuses(out: Path) -> list[tuple[str, str]]:
    return [(row["name"], row["status"]) for row in manifest(out)["captures"]]
