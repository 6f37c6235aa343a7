"""`gnmreg model anatomy` and `gnmreg model place`: what they write, read of real tongues, and refuse."""

import json
import shutil
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from coregister.anatomy.assemble import AnatomySettings, regenerate
from coregister.anatomy.tongue_mouth import JawOpening
from coregister.evaluate.evaluation import HeldOutSubject
from registration.errors import InputError
from registration.model import gnm_npz
from registration.model.gnm_npz import GNMData
from registration.progress import NullProgress
from tests.coregister.anatomy.test_placement import with_lips_inside
from tests.coregister.conftest import model, model_file, wheel  # noqa: F401  fixtures
from tests.fixtures.make_fixtures import HERE
from workflows.cli.app import main
from workflows.records.training_subjects import write_held_out
from workflows.steps import build
from workflows.steps.anatomy import TongueFiles, write_anatomy, write_placed

TINY = HERE / "tiny_gnm.npz"
PUPILS = AnatomySettings(parts=("pupils",))


@pytest.fixture(scope="module")
def previous(model_file: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:  # noqa: F811
    """A model with a landmark scheme and statistics of expressions beside it."""
    file = tmp_path_factory.mktemp("previous") / "before.npz"
    shutil.copyfile(model_file, file)
    shutil.copy(model_file.with_name("head_sparse_68.txt"), file.parent)
    np.savez(file.with_name("before.expressions.npz"), coefficients=np.zeros(3))
    return file


def test_the_model_lies_with_all_that_belongs_to_it(previous: Path, model: GNMData, tmp_path: Path) -> None:  # noqa: F811
    out = tmp_path / "new" / "after.npz"
    lines = write_anatomy(previous, out, PUPILS, NullProgress())
    written, expected = gnm_npz.read(out), regenerate(model, PUPILS)
    assert gnm_npz.content_hash(written) == gnm_npz.content_hash(expected.data)
    manifest = json.loads(out.with_name("after.manifest.json").read_text())
    assert manifest["content_id"] == gnm_npz.content_hash(written)
    assert manifest["anatomy"] == expected.anatomy
    for name in ("head_sparse_68.txt", "before.expressions.npz"):
        copied = out.with_name(name.replace("before", "after"))
        assert copied.read_bytes() == previous.with_name(name).read_bytes()
    layout = ", ".join(f"{name} {count}" for name, count in expected.anatomy["layout"].items())
    assert lines == ["pupils: 1 components of 0 samples, 100.00% of the variance", f"components: {layout}"]


@pytest.mark.parametrize(
    ("out", "settings", "text"),
    [
        ("before.npz", PUPILS, "model"),
        ("after.obj", PUPILS, "after.obj"),
        ("after.npz", replace(PUPILS, parts=()), "parts"),
        ("after.npz", replace(PUPILS, seed=-1), "seed"),
    ],
)
def test_what_cannot_be_written_is_refused_first(
    previous: Path, monkeypatch: pytest.MonkeyPatch, out: str, settings: AnatomySettings, text: str
) -> None:
    monkeypatch.setattr("workflows.steps.anatomy.regenerate", lambda *_: pytest.fail("it has begun"))
    before = sorted(file.name for file in previous.parent.iterdir())
    with pytest.raises(InputError) as error:
        write_anatomy(previous, previous.with_name(out), settings, NullProgress())
    assert text in str(error.value)
    assert sorted(file.name for file in previous.parent.iterdir()) == before


def people(model: GNMData, expressions: np.ndarray) -> list[HeldOutSubject]:  # noqa: F811
    """One person with these displacements, turned and moved as a capture's world is."""
    turn, template = Rotation.from_rotvec((0.3, -0.5, 0.1)), model.template_vertex_positions.astype(np.float64)
    moved = [turn.apply(template + displacement) + (0.1, 1.5, -0.3) for displacement in (0, *expressions)]
    return [
        HeldOutSubject(
            subject="anna",
            neutral=moved[0],
            expressions=np.array(moved[1:]).reshape(-1, *template.shape),
            categories=("jaw",) * len(expressions),
        )
    ]


@pytest.fixture(scope="module")
def opened(model: GNMData) -> np.ndarray:  # noqa: F811
    jaw = JawOpening.of(model)
    return jaw.displacement(jaw.coefficients(0.03))


def test_expressions_are_displacements_in_the_frame_of_the_model(
    model: GNMData,  # noqa: F811
    opened: np.ndarray,
    tmp_path: Path,
) -> None:
    file = tmp_path / "people.npz"
    write_held_out(people(model, opened[None]), model.triangles, file)
    sources, digests = TongueFiles(registrations=file).read(model)
    assert len(sources.expressions) == 1 and not sources.fill
    assert np.abs(sources.expressions[0] - opened).max() < 1e-6
    write_held_out(people(model, 0.9 * opened[None]), model.triangles, file)
    assert TongueFiles(registrations=file).read(model)[1] != digests


def test_registrations_that_show_no_tongues_are_refused(
    model: GNMData,  # noqa: F811
    opened: np.ndarray,
    tmp_path: Path,
) -> None:
    file = tmp_path / "people.npz"
    write_held_out(people(model, opened[None][:0]), model.triangles, file)
    with pytest.raises(InputError, match="no expressions"):
        TongueFiles(registrations=file).read(model)
    write_held_out(people(model, opened[None]), model.triangles[:, ::-1], file)
    with pytest.raises(InputError, match="another topology"):
        TongueFiles(registrations=file).read(model)


def test_key_points_are_read_and_hashed(model: GNMData, tmp_path: Path) -> None:  # noqa: F811
    rows = [("upper_incisors", 0, 0), ("tongue_tip", -4, -12), ("tongue_blade", 1, -25), ("tongue_dorsum", 3, -40)]
    files = [tmp_path / "a.csv", tmp_path / "b.csv"]
    for k, file in enumerate(files):
        lines = [f"0.{k},{name},0,{y},{z}" for name, y, z in rows]
        file.write_text("\n".join(["time_s,point,x_mm,y_mm,z_mm", *lines]) + "\n")
    sources, digests = TongueFiles(keypoints=tuple(files)).read(model)
    assert [recording.time_s.tolist() for recording in sources.recordings] == [[0.0], [0.1]]
    assert len(set(digests.values())) == 2


def test_the_first_round_poses_tongues_in_its_registrations(
    model: GNMData,  # noqa: F811
    opened: np.ndarray,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    template = model.template_vertex_positions
    mesh = SimpleNamespace(name="jaw_open", vertices=template + opened.astype(np.float32))
    subjects = [
        SimpleNamespace(name=name, neutral=SimpleNamespace(vertices=template), expressions=(mesh,))
        for name in ("p0", "p1", "p2")
    ]
    built = build.BuiltModel(
        data=model,
        manifest={"rejected": [{"name": "p0", "reason": ""}, {"name": "p2, jaw_open", "reason": ""}]},
        coefficients=None,
    )
    given = []

    def regenerated(data: GNMData, settings: AnatomySettings, tongues: object) -> SimpleNamespace:
        given.append(tongues)
        return SimpleNamespace(data=data, anatomy={"made": True})

    monkeypatch.setattr(build, "regenerate", regenerated)
    made = build._with_anatomy(built, AnatomySettings(parts=("tongue",)), subjects)
    (tongues,) = given
    assert tongues.fill and len(tongues.expressions) == 1
    assert np.abs(tongues.expressions[0] - opened).max() < 1e-6
    assert made.manifest["anatomy"] == {"made": True}
    build._with_anatomy(built, PUPILS, subjects)
    assert given[1] is None


def test_a_placed_model_says_what_moved(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    data, previous = with_lips_inside(gnm_npz.read(TINY)), tmp_path / "before.npz"
    gnm_npz.write(data, previous)
    np.savez(previous.with_name("before.expressions.npz"), coefficients=np.zeros(3))
    out = tmp_path / "new" / "placed.npz"
    assert main(["model", "place", str(previous), "--out", str(out)]) == 0
    printed = capsys.readouterr().out
    assert "identity: " in printed and "of teeth and tongue" in printed and str(out) in printed
    manifest = json.loads(out.with_name("placed.manifest.json").read_text())
    assert manifest["content_id"] == gnm_npz.content_hash(gnm_npz.read(out))
    assert out.with_name("placed.expressions.npz").is_file()
    with pytest.raises(InputError):
        write_placed(previous, previous)
