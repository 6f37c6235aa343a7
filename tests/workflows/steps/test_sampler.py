"""`gnmreg sampler train` and `gnmreg sample`, on coefficients of the tiny model."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import safetensors.numpy
from PIL import Image

from coregister.sampler.keras_decoder import FILES
from coregister.sampler.storage import RECORD, TENSORS, read_sampler
from registration.errors import InputError
from registration.model import gnm_npz
from registration.storage.mesh_files import read_mesh
from tests.conftest import FIXTURES
from tests.coregister.sampler.hdf5_decoder import write_decoder
from tests.registration.capture import small
from tests.registration.stabilize.runs import write_subject
from workflows.cli.app import main
from workflows.records.coefficients import read_coefficients

MODEL = FIXTURES / "tiny_gnm.npz"
SIZES = (6, 7)  # coefficients of the tiny model


def write_coefficients(file: Path, count: int = 96, **changes: np.ndarray) -> Path:
    rng = np.random.default_rng(0)
    number = np.arange(count)
    arrays = {
        "identity": rng.normal(size=(count, SIZES[0])) + (number % 2)[:, None],
        "expression": 0.3 * rng.normal(size=(count, SIZES[1])) + (number % 3)[:, None],
        "subjects": np.array([f"p{k:03d}" for k in number]),
        "labels": np.array(["open", "closed", "neutral"])[number % 3],
        "tag_gender": np.array(["female", "male"])[number % 2],
        "tag_ethnicity": np.array(["asian", "black", "white"])[number // 2 % 3],
        "model": np.array(gnm_npz.content_hash(gnm_npz.read(MODEL))),
    }
    np.savez(file, **{name: value for name, value in {**arrays, **changes}.items() if value is not None})
    return file


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("sampler")
    file = write_coefficients(folder / "coefficients.npz")
    words = ["sampler", "train", file, "--model", MODEL, "--out", folder / "S", "--steps", 30]
    assert main([str(word) for word in words]) in (0, 1)  # so few steps may look like a collapse
    return folder / "S"


def _sample(sampler: Path, out: Path, *words: object) -> int:
    return main([str(word) for word in ("sample", "--sampler", sampler, "--model", MODEL, "--out", out, *words)])


def test_a_trained_sampler_is_a_folder_with_its_report(trained):
    assert sorted(path.name for path in trained.iterdir()) == [
        *("contact_sheet.png", "sampler.json", "sampler.safetensors", "training.png"),
    ]
    sampler, record = read_sampler(trained)
    assert [f.name for f in sampler.decoders["identity"].factors] == ["gender", "ethnicity"]
    assert sampler.decoders["expression"].factors[0].categories == ("closed", "open")
    assert record.parts["expression"].counts == {"expression": {"closed": 29, "open": 29}} or record.parts[
        "expression"
    ].training_samples == sum(record.parts["expression"].counts["expression"].values())
    assert set(record.depth_mm) == {"closed", "open"}
    assert len(record.parts["identity"].metrics.kl) == 64


def test_drawn_heads_are_written_with_their_categories(trained, tmp_path, capsys):
    asked = ("--gender", "female", "--ethnicity", "asian=2,white=3", "--expression", "open=0.7,closed=0.3")
    assert _sample(trained, tmp_path / "out", *asked, "--count", 2, "--seed", 1) == 0
    assert "the weights of ethnicity sum to 5" in capsys.readouterr().out
    manifest = json.loads((tmp_path / "out" / "manifest.json").read_text())
    assert manifest["heads"][0]["categories"]["ethnicity"] == {"asian": 0.4, "white": 0.6}
    arrays = np.load(tmp_path / "out" / "coefficients.npz")
    data = gnm_npz.read(MODEL)
    moved = np.tensordot(arrays["identity"][1], data.vertex_identity_basis, 1)
    moved += np.tensordot(arrays["expression"][1], data.expression_basis, 1)
    mesh = read_mesh(tmp_path / "out" / manifest["heads"][1]["mesh"])
    np.testing.assert_allclose(mesh.vertices, data.template_vertex_positions + moved, atol=1e-5)
    with Image.open(tmp_path / "out" / "contact_sheet.png") as page:
        assert page.width > 400
    before = (tmp_path / "out" / "coefficients.npz").read_bytes()
    assert _sample(trained, tmp_path / "out", *asked, "--count", 2, "--seed", 1) == 0
    assert (tmp_path / "out" / "coefficients.npz").read_bytes() == before


def test_released_decoders_draw_expressions(tmp_path, capsys):
    write_decoder(tmp_path / FILES["expression"], (84, 8, SIZES[1]))
    write_decoder(tmp_path / FILES["identity"], (70, 8, 253))
    assert _sample(tmp_path, tmp_path / "out", "--expression", "happy=0.7,surprise=0.3", "--count", 1) == 0
    assert "all heads have the template's identity" in capsys.readouterr().out
    assert _sample(tmp_path, tmp_path / "other", "--gender", "female") == 2


def test_input_that_cannot_be_used_is_refused(trained, tmp_path, capsys):
    for words, found in (
        (("--ethnicity", "purple"), "asian, black, white"),
        (("--factor", "age"), "FACTOR:NAME"),
        (("--factor", "age:20-29"), "gender, ethnicity, expression"),
        (("--count", "0"), "--count"),
    ):
        assert _sample(trained, tmp_path / "out", *words) == 2
        assert found in capsys.readouterr().err
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "notes.txt").write_text("keep")
    assert _sample(trained, tmp_path / "mine") == 2
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("changes", "found"),
    [
        ({"tag_gender": None}, "tag_gender"),
        ({"labels": np.array(["open"] * 96)}, "only open"),
        ({"labels": np.array(["open"] * 95 + ["closed"])}, "1 of closed"),
        ({"labels": np.array([f"act{k}" for k in range(96)])}, "96 for 96"),
        ({"identity": np.zeros((96, 5))}, "5 identity"),
        ({"identity": np.full((96, 6), np.nan)}, "finite"),
        ({"model": np.array("0" * 64)}, "another model"),
    ],
)
def test_coefficients_that_cannot_be_used_are_refused(tmp_path, capsys, changes, found):
    file = write_coefficients(tmp_path / "c.npz", **changes)
    words = ["sampler", "train", file, "--model", MODEL, "--out", tmp_path / "S", "--steps", 1]
    assert main([str(word) for word in words]) == 2
    assert found in capsys.readouterr().err
    assert not (tmp_path / "S").exists()


def test_a_changed_sampler_is_refused(trained, tmp_path):
    def changed(name: str, content: bytes) -> Path:
        folder = tmp_path / "changed"
        shutil.rmtree(folder, ignore_errors=True)
        shutil.copytree(trained, folder)
        (folder / name).write_bytes(content)
        return folder

    arrays = safetensors.numpy.load_file(trained / TENSORS)
    key = "identity.decoder.0.weight"
    missing = {name: array for name, array in arrays.items() if name != key}
    wrong = {**arrays, key: arrays[key][:, 1:].copy()}
    for damaged in (missing, wrong, {**arrays, key: arrays[key] + 1}, {**arrays, key: arrays[key] * np.nan}):
        with pytest.raises(InputError):
            read_sampler(changed(TENSORS, safetensors.numpy.save(damaged)))
    record = json.loads((trained / RECORD).read_text())
    for path, value in (("latent", 10**9), ("layers", []), ("factors", []), ("scale", "1")):
        record_ = json.loads(json.dumps(record))
        record_["parts"]["identity"][path] = value
        with pytest.raises(InputError):
            read_sampler(changed(RECORD, json.dumps(record_).encode()))


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """A run of five subjects with two expressions each, and their captures; the last subject has no gender."""
    folder = tmp_path_factory.mktemp("run")
    data = gnm_npz.read(MODEL)
    small.make(folder / "capture")
    rng = np.random.default_rng(2)
    for number, tag in enumerate(("female", "male", "female", "male", None)):
        person, identity = f"p{number}", rng.normal(size=SIZES[0]).astype(np.float32)
        acts = {"rest": "neutral", "a": "smile", "b": "jaw_open"}
        heads = {
            name: (label, data.template_vertex_positions, np.ones(len(data.template_vertex_positions)))
            for name, label in acts.items()
        }
        coefficients = {
            name: {"identity": identity, "expression": (k * rng.normal(size=SIZES[1])).astype(np.float32)}
            for k, name in enumerate(acts)
        }
        write_subject(folder / "run" / person, person, data, heads, coefficients)
        shutil.copytree(folder / "capture", folder / "captures" / person / "rest")
        lines = [f'subject = "{person}"', 'expression = "neutral"', 'units = "m"', f"age = {30 + 10 * (number // 2)}"]
        lines += [f'gender = "{tag}"'] if tag else []
        (folder / "captures" / person / "rest" / "capture.toml").write_text("\n".join([*lines, ""]))
    return folder / "run", folder / "captures"


def test_a_run_is_trained_on_with_the_tags_of_its_captures(run, tmp_path, capsys):
    registrations, captures = run
    words = ["sampler", "train", registrations, "--captures", captures, "--model", MODEL, "--out", tmp_path / "S"]
    assert main([str(word) for word in (*words, "--factors", "gender", "--steps", 20)]) in (0, 1)
    assert "1 subjects without a tag are left out" in capsys.readouterr().out
    _, record = read_sampler(tmp_path / "S")
    assert record.parts["identity"].counts == {"gender": {"female": 2, "male": 2}}
    counts = record.parts["expression"].counts["expression"]
    assert set(counts) == {"jaw_open", "smile"} and sum(counts.values()) == 10
    assert "p0/rest" in record.inputs
    read = read_coefficients(registrations, captures, ("gender", "age"))
    assert read.tags["age"] == ("30-39",) * 6 + ("40-49",) * 6 + ("50-59",) * 3
    assert read.labels[:3] == ("neutral", "smile", "jaw_open") and (read.identity[0] == read.identity[2]).all()


def test_what_a_run_lacks_for_its_tags_is_said(run, tmp_path, capsys):
    registrations, captures = run
    words = ["sampler", "train", registrations, "--model", MODEL, "--out", tmp_path / "S", "--steps", 1]
    for more, found in (
        ((), "give --captures"),
        (("--captures", captures), "of 5 subjects gender of 4, ethnicity of 0"),
        (("--captures", tmp_path / "nowhere"), "nowhere"),
        (("--captures", captures, "--factors", "age"), "5 for 3"),
    ):
        assert main([str(word) for word in (*words, *more)]) == 2
        assert found in capsys.readouterr().err
    assert main([str(word) for word in (*words, "--factors")]) in (0, 1)  # expressions alone need no captures
    assert set(read_sampler(tmp_path / "S")[1].parts) == {"expression"}


def test_a_run_needs_registrations(tmp_path):
    with pytest.raises(InputError, match="no registrations"):
        read_coefficients(tmp_path, None, ())
