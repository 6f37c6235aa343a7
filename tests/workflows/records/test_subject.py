"""Unusable folders and settings of a subject are refused."""

import shutil
from pathlib import Path

import pytest

from registration.errors import InputError
from registration.options import RegisterOptions
from tests.workflows.conftest import MODEL, FakeRegister, change
from workflows.records.subject import SubjectRecord
from workflows.steps.subject import register_subject


def files(folder: Path) -> list[Path]:
    return sorted(folder.rglob("*"))


def nothing(subject: Path) -> dict:
    return {}


def changed(capture: str, old: str, new: str):
    def prepare(subject: Path) -> dict:
        change(subject / capture, old, new)
        return {}

    return prepare


def with_output(name: str):
    def prepare(subject: Path) -> dict:
        folder = subject.parent / "out" / name
        folder.mkdir(parents=True)
        (folder / "mine.txt").write_text("mine")
        if name != ".":
            SubjectRecord(subject="ball", model="ab", recipe="draft", neutral="rest", rows=()).write(
                folder.parent / "subject.json"
            )
        return {}

    return prepare


def without(*names: str):
    def prepare(subject: Path) -> dict:
        for name in names:
            shutil.rmtree(subject / name)
        return {}

    return prepare


def unreadable(name: str, **options):
    def prepare(subject: Path) -> dict:
        shutil.rmtree(subject / name / "sparse")
        return options

    return prepare


@pytest.mark.parametrize(
    ("prepare", "options", "what", "got"),
    [
        (lambda subject: {"subject_dir": subject / "nowhere"}, {}, "folder is missing", "no such folder"),
        (lambda subject: {"subject_dir": subject / "notes.txt"}, {}, "folder is missing", "a file"),
        (lambda subject: {"subject_dir": subject / "notes"}, {}, "no captures", "none"),
        (lambda subject: {"subject_dir": subject / "rest"}, {}, "no captures", "a capture"),
        (without("rest"), {}, "no neutral", "jaw2: jaw, jaw10: jaw, smile: smile"),
        (unreadable("rest"), {}, "no neutral", "rest: cannot be read"),
        (unreadable("rest", neutral="rest"), {}, "COLMAP model is missing", "no such folder"),
        (changed("smile", '"smile"', '"neutral"'), {}, "two neutrals", "rest, smile"),
        (nothing, {"neutral": "notes"}, "no such capture", "notes"),
        (changed("smile", '"ball"', '"cube"'), {}, "several subjects", "smile: cube"),
        (with_output("."), {}, "output folder", "other contents"),
        (with_output("smile"), {}, "output folder", "mine.txt"),
        (lambda subject: {"out": subject}, {}, "output folder", "other contents"),
        (lambda subject: {"out": subject / "smile" / "out"}, {}, "output folder", "inside the capture smile"),
        (lambda subject: {"out": subject / "smile"}, {}, "output folder", "inside the capture smile"),
        (lambda subject: {"out": subject / "notes.txt"}, {}, "output folder", "a file"),
        (lambda subject: (subject / "smile").rename(subject / "index.html") and {}, {}, "output", "named index.html"),
        (nothing, {"options": RegisterOptions(recipe="drafty")}, "no such recipe", "drafty"),
        (
            nothing,
            {"options": RegisterOptions(landmark_files={"68": Path("nowhere.txt")})},
            "cannot be read",
            "nowhere.txt",
        ),
        (nothing, {"model": Path("nowhere.npz")}, "", "nowhere.npz"),
    ],
)
def test_bad_input_is_refused_before_any_registration(prepare, options, what, got, subject: Path, fake: FakeRegister):
    options = {**options, **(prepare(subject) or {})}
    before = files(subject.parent)
    folder = options.pop("subject_dir", subject)
    with pytest.raises(InputError) as refused:
        register_subject(folder, **{"model": MODEL, "out": subject.parent / "out", **options})
    assert what in refused.value.what and got in str(refused.value)
    assert fake.calls == [] and files(subject.parent) == before
