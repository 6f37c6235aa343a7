"""A subject's captures, one after the other. The registrations are stand-ins, but for the last test."""

import base64
import json
import os
import re
import shutil
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
import trimesh

import workflows.local
from registration.artifacts import AXES, load_registration, read_manifest, save_registration
from registration.errors import InputError
from registration.evaluate.evaluation import evaluate_folder
from registration.register import register
from registration.render import backend
from registration.stages import RECIPES, Recipe, draft
from registration.types import Registration
from tests.capture import small
from tests.register import synthetic
from tests.report.test_page import a_registration
from workflows.local import register_subject
from workflows.subject_folder import Row, Subject
from workflows.subject_page import thumbnail, write_subject_page

MODEL = synthetic.MODEL
REFUSED = InputError("The lens is dirty", where="cam3", expected="a clean one", got="dust", fix="wipe it")


@pytest.fixture(scope="session")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A capture with a scan but no truth: measuring drift takes a second."""
    folder = small.make(tmp_path_factory.mktemp("ball") / "ball")
    (folder / "ground_truth.npz").unlink()
    return folder


@pytest.fixture
def subject(capture: Path, tmp_path: Path) -> Path:
    """A folder of four captures and of things that are none."""
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
    """The same true points for each capture."""
    for name in names:
        np.savez(subject / name / "ground_truth.npz", vertices=small.landmarks_68())


def change(folder: Path, old: str, new: str) -> None:
    file = folder / "capture.toml"
    text = file.read_text()
    assert old in text
    file.write_text(text.replace(old, new))


class FakeRegister:
    """Stands in for `register`: writes the true ball, of an expression moved by a millimetre."""

    def __init__(self) -> None:
        self.outcomes: dict[str, str | BaseException] = {}  # capture -> a status, or what is raised
        self.calls: list[tuple[str, Path, Path | None]] = []  # capture, out, neutral
        self.settings: list[Mapping[str, object]] = []
        self.seen: list[list[tuple[str, str]]] = []  # subject.json's rows at each call

    def __call__(self, capture_path: Path, *, out: Path, neutral: Path | None, progress, **settings) -> Registration:
        self.calls.append((capture_path.name, out, neutral))
        self.settings.append(settings)
        self.seen.append(statuses(out.parent))
        progress.at(1, 2, "fitting")
        outcome = self.outcomes.get(capture_path.name, "converged")
        if isinstance(outcome, BaseException):
            raise outcome
        ball = trimesh.creation.icosphere(subdivisions=3, radius=small.RADIUS_M)
        moved = np.array(ball.vertices + (0 if neutral is None else (1e-3, 0, 0)), np.float32)
        result = a_registration(
            status=outcome,
            reason=f"it is {outcome}",
            vertices=moved,
            offsets=np.zeros_like(moved),
            confidence=np.ones(len(moved), np.float32),
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
    monkeypatch.setattr(workflows.local, "register", fake)
    return fake


class Notes:
    """A progress that keeps what it is told."""

    def __init__(self) -> None:
        self.notes: list[str] = []
        self.steps: list[str] = []

    def note(self, text: str) -> None:
        self.notes.append(text)

    def at(self, done: int, total: int, what: str) -> None:
        self.steps.append(what)


def run(subject: Path, **options) -> Subject:
    out = options.pop("out", subject.parent / "out")
    return register_subject(subject, model_path=MODEL, out=out, **options)


def manifest(out: Path) -> dict:
    return json.loads((out / "subject.json").read_text())


def statuses(out: Path) -> list[tuple[str, str]]:
    return [(row["name"], row["status"]) for row in manifest(out)["captures"]]


def files(folder: Path) -> list[Path]:
    return sorted(folder.rglob("*"))


def test_the_neutral_first_then_each_expression_from_it(subject: Path, fake: FakeRegister, tmp_path: Path):
    progress, out = Notes(), tmp_path / "out"
    settings = dict(recipe="studio", views=3, seed=4, deterministic=True, force=True, variant="cuda")
    scheme = synthetic.FIXTURES / "head_sparse_68.txt"
    run(subject, progress=progress, landmark_files={"68": scheme}, **settings)
    assert fake.calls == [
        ("rest", out / "rest", None),
        *((name, out / name, out / "rest") for name in ("jaw2", "jaw10", "smile")),
    ]
    assert fake.settings == 4 * [{**settings, "model_path": MODEL, "landmark_files": {"68": scheme}}]
    assert progress.steps[:2] == ["rest (1 of 4): fitting", "jaw2 (2 of 4): fitting"]
    assert "smile (4 of 4): converged: it is converged" in progress.notes


def test_what_subject_json_holds(subject: Path, fake: FakeRegister, tmp_path: Path):
    out = tmp_path / "out"
    run(subject)
    told = manifest(out)
    assert (told["kind"], told["schema"], told["subject"]) == ("gnm-subject", 1, "ball")
    assert (told["recipe"], told["neutral"]) == ("draft", "rest")
    assert re.fullmatch("[0-9a-f]{64}", told["model"])
    rest, jaw, *_ = told["captures"]
    assert rest == {
        "name": "rest",
        "expression": "neutral",
        "status": "converged",
        "reason": "it is converged",
        "figures": {"scan_to_mesh": {"face": {"mean_mm": 0.25, "median_mm": 0.125}}},
        "seconds": 201.0,
        "folder": "rest",
    }
    assert (jaw["name"], jaw["expression"], jaw["folder"]) == ("jaw2", "jaw", "jaw2")
    assert sorted(path.name for path in out.iterdir()) == [
        "index.html", "jaw10", "jaw2", "rest", "smile", "subject.json"
    ]  # fmt: skip


def test_the_drift_is_that_of_evaluate(subject: Path, fake: FakeRegister, tmp_path: Path):
    """Both truths are one and the same, the surface moved by a millimetre."""
    out = tmp_path / "out"
    add_truths(subject, "rest", "smile")
    run(subject)
    figures = read_manifest(out / "smile")["figures"]
    assert figures["drift"]["face"]["mean_mm"] == pytest.approx(1.0, abs=0.05)
    assert "drift" not in read_manifest(out / "rest")["figures"]
    told = manifest(out)["captures"][-1]["figures"]
    assert told == {name: {"face": figures[name]["face"]} for name in ("scan_to_mesh", "drift")}
    by_hand = evaluate_folder(out / "smile", subject / "smile", out / "rest", subject / "rest").figures
    assert by_hand["drift"] == figures["drift"] and by_hand["scan_to_mesh"] == figures["scan_to_mesh"]


@pytest.mark.parametrize(
    "change_truths",
    [
        lambda folder: (folder / "smile" / "ground_truth.npz").unlink(),
        lambda folder: (folder / "rest" / "ground_truth.npz").unlink(),
        lambda folder: (folder / "rest" / "scan.ply").unlink(),
        lambda folder: (folder / "smile" / "scan.ply").unlink(),
        lambda folder: np.savez(folder / "smile" / "ground_truth.npz", vertices=np.zeros((5, 3))),
    ],
)
def test_no_drift_without_comparable_truths(change_truths, subject: Path, fake: FakeRegister):
    add_truths(subject, "rest", "smile")
    change_truths(subject)
    row = run(subject).rows[-1]
    assert (row.status, row.reason) == ("converged", "it is converged")
    assert set(row.figures) == {"scan_to_mesh"}


def test_an_unmeasured_drift_is_told(subject: Path, fake: FakeRegister):
    add_truths(subject, "rest")
    (subject / "jaw10" / "ground_truth.npz").write_bytes(b"broken")
    rest, jaw2, row, smile = run(subject).rows
    assert smile.reason == "it is converged"
    assert row.status == "converged" and row.folder == "jaw10"
    assert "the drift could not be measured: The ground truth cannot be used" in row.reason


@pytest.mark.parametrize(
    ("outcome", "status", "reason"),
    [
        (REFUSED, "error", "The lens is dirty: cam3; expected a clean one, got dust; wipe it"),
        (RuntimeError("out of luck"), "error", "RuntimeError: out of luck"),
        ("failed", "failed", "it is failed"),
    ],
)
def test_one_failure_does_not_stop_the_others(outcome, status, reason, subject: Path, fake: FakeRegister):
    progress = Notes()
    fake.outcomes["jaw2"] = outcome
    result = run(subject, progress=progress)
    assert fake.order == ["rest", "jaw2", "jaw10", "smile"]
    assert [row.status for row in result.rows] == ["converged", status, "converged", "converged"]
    row = result.rows[1]
    assert row.reason == reason
    assert row.folder == (None if status == "error" else "jaw2")
    assert any("Traceback" in note for note in progress.notes) == isinstance(outcome, RuntimeError)


@pytest.mark.parametrize(
    ("outcome", "reason"),
    [("failed", "it is failed"), (REFUSED, "The lens is dirty"), (ValueError("odd"), "ValueError: odd")],
)
def test_without_a_neutral_no_expression_is_tried(outcome, reason: str, subject: Path, fake: FakeRegister):
    fake.outcomes["rest"] = outcome
    result = run(subject)
    assert fake.order == ["rest"]
    assert [row.status for row in result.rows[1:]] == 3 * ["skipped"]
    assert all(row.reason.startswith(f"the neutral failed: {reason}") for row in result.rows[1:])
    assert not any(row.usable for row in result.rows)


def test_a_stopped_neutral_is_used(subject: Path, fake: FakeRegister):
    fake.outcomes["rest"] = "stopped"
    assert [row.status for row in run(subject).rows] == ["stopped", *3 * ["converged"]]


def test_a_capture_that_cannot_be_read_does_not_stop_the_others(subject: Path, fake: FakeRegister):
    shutil.rmtree(subject / "jaw2" / "sparse")
    result = run(subject)
    assert fake.order == ["rest", "jaw10", "smile"]
    assert result.rows[-1].name == "jaw2" and result.rows[-1].status == "error"
    assert "The COLMAP model is missing" in result.rows[-1].reason


def test_every_capture_is_on_record_at_once(subject: Path, fake: FakeRegister, tmp_path: Path):
    fake.outcomes["jaw2"] = "failed"
    run(subject)
    told = ["converged", "failed", "converged", "converged"]
    for count, seen in enumerate(fake.seen):
        assert [status for _, status in seen] == [*told[:count], *(4 - count) * ["waiting"]]


def test_an_interrupted_run_is_on_record_and_goes_on(subject: Path, fake: FakeRegister, tmp_path: Path):
    out = tmp_path / "out"
    fake.outcomes["jaw10"] = KeyboardInterrupt()
    with pytest.raises(KeyboardInterrupt):
        run(subject)
    assert statuses(out) == [("rest", "converged"), ("jaw2", "converged"), ("jaw10", "waiting"), ("smile", "waiting")]
    assert not [path for path in out.iterdir() if path.name.startswith(".")]
    assert "2 of 4" in (out / "index.html").read_text()
    fake.outcomes.clear()
    run(subject)
    assert {status for _, status in statuses(out)} == {"converged"}


def test_a_crash_while_writing_leaves_the_former_record(subject: Path, fake: FakeRegister, tmp_path, monkeypatch):
    out = tmp_path / "out"
    run(subject)
    before = manifest(out)
    monkeypatch.setattr(os, "replace", lambda *paths: (_ for _ in ()).throw(OSError("no space left")))
    with pytest.raises(OSError, match="no space left"):
        run(subject)
    assert manifest(out) == before
    assert not [path for path in out.iterdir() if path.name.startswith(".")]


def test_a_drift_that_is_newer_than_the_neutral_stays(subject: Path, fake: FakeRegister, tmp_path: Path, monkeypatch):
    out, asked = tmp_path / "out", []
    add_truths(subject, "rest", "jaw2", "smile")
    run(subject)
    monkeypatch.setattr(workflows.local, "register", lambda capture, *, out, **settings: load_registration(out))

    def listen(registration, capture, **options):
        asked.append(capture.root.name)
        raise REFUSED

    monkeypatch.setattr(workflows.local, "evaluate", listen)
    again = run(subject)
    assert asked == [] and again.rows[-1].figures["drift"]["face"]["mean_mm"] == pytest.approx(1.0, abs=0.05)
    os.utime(out / "rest" / "manifest.json")
    run(subject)
    assert asked == ["jaw2", "smile"]


def test_another_capture_as_the_neutral(subject: Path, fake: FakeRegister):
    change(subject / "smile", '"smile"', '"neutral"')
    assert run(subject, neutral="smile").neutral == "smile"
    assert fake.order == ["smile", "jaw2", "jaw10", "rest"]


def test_the_recorded_folder_is_replaced_only_for_its_subject(subject: Path, fake: FakeRegister, tmp_path: Path):
    run(subject)
    for name in ("rest", "jaw2", "jaw10", "smile"):
        change(subject / name, '"ball"', '"cube"')
    with pytest.raises(InputError, match="cannot be used") as refused:
        run(subject)
    assert "'ball'" in str(refused.value) and len(fake.calls) == 4


def nothing(subject: Path) -> dict:
    return {}


def other(capture: str, old: str, new: str):
    def do(subject: Path) -> dict:
        change(subject / capture, old, new)
        return {}

    return do


def filled(name: str):
    def do(subject: Path) -> dict:
        place = subject.parent / "out" / name
        place.mkdir(parents=True)
        (place / "mine.txt").write_text("mine")
        if name != ".":
            (place.parent / "subject.json").write_text('{"kind": "gnm-subject", "subject": "ball"}')
        return {}

    return do


def without(*names: str):
    def do(subject: Path) -> dict:
        for name in names:
            shutil.rmtree(subject / name)
        return {}

    return do


def unreadable(name: str, **options):
    def do(subject: Path) -> dict:
        shutil.rmtree(subject / name / "sparse")
        return options

    return do


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
        (other("smile", '"smile"', '"neutral"'), {}, "two neutrals", "rest, smile"),
        (nothing, {"neutral": "notes"}, "no such capture", "notes"),
        (other("smile", '"ball"', '"cube"'), {}, "several subjects", "smile: cube"),
        (filled("."), {}, "output folder", "other things"),
        (filled("smile"), {}, "output folder", "mine.txt"),
        (lambda subject: {"out": subject}, {}, "output folder", "other things"),
        (lambda subject: {"out": subject / "smile" / "out"}, {}, "output folder", "inside the capture smile"),
        (lambda subject: {"out": subject / "smile"}, {}, "output folder", "inside the capture smile"),
        (lambda subject: {"out": subject / "notes.txt"}, {}, "output folder", "a file"),
        (lambda subject: (subject / "smile").rename(subject / "index.html") and {}, {}, "output", "named index.html"),
        (nothing, {"recipe": "drafty"}, "no such recipe", "drafty"),
        (nothing, {"landmark_files": {"68": Path("nowhere.txt")}}, "cannot be read", "nowhere.txt"),
        (nothing, {"model_path": Path("nowhere.npz")}, "", "nowhere.npz"),
    ],
)
def test_bad_input_is_told_before_any_work(prepare, options, what, got, subject: Path, fake: FakeRegister):
    options = {**options, **(prepare(subject) or {})}
    before = files(subject.parent)
    folder = options.pop("subject_dir", subject)
    with pytest.raises(InputError) as refused:
        register_subject(folder, **{"model_path": MODEL, "out": subject.parent / "out", **options})
    assert what in refused.value.what and got in str(refused.value)
    assert fake.calls == [] and files(subject.parent) == before


def a_subject(*rows: Row) -> Subject:
    return Subject(subject="a<b>", model="ab" * 32, recipe="draft", neutral="rest", rows=rows)


def test_the_page_shows_every_row_and_needs_nothing_else():
    figures = {"scan_to_mesh": {"face": {"mean_mm": 0.1234, "median_mm": 0.0456}}, "drift": {"face": {"mean_mm": 0.5}}}
    page = write_subject_page(
        a_subject(
            Row(name="rest", expression="neutral", status="converged", figures=figures, seconds=66.4, folder="rest"),
            Row(name="big <smile>", expression="x&y", status="failed", reason="<off>", folder="big <smile>"),
            Row(name="gone", expression="gone", status="error", reason="lost"),
            Row(name="later", expression="later"),
        ),
        {"rest": "data:image/jpeg;base64,AAAA"},
    )
    assert "<b>" not in page and "<smile>" not in page and "<off>" not in page
    assert "a&lt;b&gt;" in page and "x&amp;y" in page and "&lt;off&gt;" in page
    for text in ("0.123", "0.046", "0.500", "66 s", "lost", "1 of 4", "1 is waiting"):
        assert text in page, text
    links = re.findall(r'(?:src|href)="([^"]*)"', page)
    assert set(links) == {"data:image/jpeg;base64,AAAA", "rest/report.html", "big%20%3Csmile%3E/report.html"}
    assert not re.search("<script|@import|url", page)
    rows = page.split("<tr>")
    assert "waiting" in rows[-1] and "href" not in rows[-1] and "href" not in rows[-2]


def test_a_thumbnail_shows_the_face_upright():
    """A square in four colours that looks out of the face (+Z); the capture's world is turned."""
    corners = np.array([[-0.1, -0.1, 0], [0.1, -0.1, 0], [0.1, 0.1, 0], [-0.1, 0.1, 0]], np.float32)
    root = np.array([0.4, 0.9, -0.2], np.float32)
    uvs = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], np.float32)  # v is up: row 0 of the texture is on top
    triangles = np.array([[0, 1, 2], [0, 2, 3]], np.int32)
    colours = np.array([[[1, 0, 0], [0, 1, 0]], [[0, 0, 1], [0, 0, 0]]], np.float32)  # red green / blue black
    square = a_registration(
        vertices=corners @ cv2.Rodrigues(root.astype(float))[0].T.astype(np.float32) + np.float32(0.7),
        triangles=triangles,
        corner_uvs=uvs[triangles],
        texture=colours,
        rotations=root[None],
    )
    encoded = base64.b64decode(thumbnail(square).removeprefix("data:image/jpeg;base64,"))
    picture = cv2.imdecode(np.frombuffer(encoded, np.uint8), cv2.IMREAD_COLOR)[..., ::-1]
    height, width, _ = picture.shape
    middle, step = np.array([height // 2, width // 2]), width // 4
    for (row, column), colour in np.ndenumerate(np.array(["red", "green", "blue", "black"]).reshape(2, 2)):
        y, x = middle + step * (2 * np.array([row, column]) - 1)
        want = {"red": (255, 0, 0), "green": (0, 255, 0), "blue": (0, 0, 255), "black": (0, 0, 0)}[colour]
        assert np.abs(picture[y, x].astype(int) - want).max() < 40, (colour, picture[y, x])
    assert picture[4, 4].min() > 235
    assert thumbnail(a_registration(vertices=np.full((4, 3), np.nan, np.float32))) is None


def hasty() -> Recipe:
    """A draft of a fifth of its steps."""
    recipe = draft()
    return replace(recipe, stages=tuple(replace(stage, steps=stage.steps // 5) for stage in recipe.stages))


@pytest.fixture
def threads() -> Iterator[None]:
    """Gives back the threads that a deterministic run takes from the whole process."""
    import drjit as dr

    count, lanes = torch.get_num_threads(), os.cpu_count() or 1
    yield
    torch.set_num_threads(count)
    dr.set_thread_count(lanes)


def test_a_subject_equals_its_captures_registered_by_hand(tmp_path: Path, monkeypatch, threads: None):
    monkeypatch.setitem(RECIPES, "draft", hasty)
    subject, out, settings = tmp_path / "tiny", tmp_path / "out", dict(model_path=MODEL, views=3, deterministic=True)
    for expression in ("neutral", "smile"):
        synthetic.make(subject / expression, expression)
    result = register_subject(subject, out=out, **settings)
    assert all(row.usable for row in result.rows), result.rows
    by_hand = register(subject / "smile", out=tmp_path / "smile", neutral=out / "neutral", **settings)
    stored = load_registration(out / "smile")
    for name in (*AXES, "texture"):
        first, second = (getattr(load_registration(path), name) for path in (out / "smile", tmp_path / "smile"))
        np.testing.assert_array_equal(first, second)
    assert read_manifest(out / "smile")["input_hash"] == read_manifest(tmp_path / "smile")["input_hash"]
    assert by_hand.inputs["neutral"] == stored.inputs["neutral"]
    assert stored.figures["drift"]["face"]["mean_mm"] < 2.0
    record = manifest(out)
    assert record["captures"][1]["figures"]["drift"] == stored.figures["drift"]

    def stop(*args, **kwargs):
        raise AssertionError("there was nothing to compute")

    monkeypatch.setattr(backend, "activate", stop)
    monkeypatch.setattr(workflows.local, "evaluate", stop)
    register_subject(subject, out=out, **settings)
    assert manifest(out) == record
