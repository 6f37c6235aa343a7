"""`gnmreg model compare`: the folder that it writes, resumption, another topology through a map, and refusals."""

import csv
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import workflows.steps.compare
from bench.support.flame_shaped import flame_shaped, write_flame_npz
from coregister.evaluate.face_adam import AdamSettings
from coregister.evaluate.face_data import FaceSample
from coregister.evaluate.face_protocol import ProtocolSettings
from registration.errors import InputError
from registration.geometry.closest_point import closest_points
from registration.model import gnm_npz
from registration.model.landmarks import read_scheme
from registration.topology_map import file as map_file
from registration.topology_map.topology_map import SurfacePoints, TopologyMap
from tests.conftest import FIXTURES
from tests.coregister.spectrum import heads, spectrum_model, with_identity
from workflows.cli.app import main
from workflows.records.face_samples import read_samples, write_samples
from workflows.steps.compare import MANIFEST, NUMBERS, PAGE, ComparisonInput, ComparisonManifest, compare_models

SETTINGS = ProtocolSettings(
    points=200, adam=AdamSettings(steps=20, refresh=20), components=(4,), random_heads=3, draws=100, adam_samples=1
)


@pytest.fixture(scope="module")
def given(tmp_path_factory) -> ComparisonInput:
    folder = tmp_path_factory.mktemp("compare")
    model = spectrum_model()
    gnm_npz.write(model, folder / "own.npz")
    gnm_npz.write(with_identity(model, model.vertex_identity_basis[6:]), folder / "weak.npz")
    shapes = heads(model, np.random.default_rng(0).standard_normal((3, 12)))
    samples = tuple(
        FaceSample(
            name=f"s{k}",
            subject=f"p{k}",
            category="neutral" if k < 2 else "jaw",
            vertices=shape,
            scan=shape if k else shape + 0.0,
            scan_triangles=model.triangles.astype(np.int64),
            tags={"age": 30 + k, "gender": "female"},
        )
        for k, shape in enumerate(shapes)
    )
    write_samples(samples, model.triangles.astype(np.int64), folder / "samples.npz")
    return ComparisonInput(models=(folder / "own.npz", folder / "weak.npz"), samples=folder / "samples.npz")


def test_samples_come_back(given):
    found = read_samples(given.samples)
    assert [sample.category for sample in found.samples] == ["neutral", "neutral", "jaw"]
    assert found.samples[1].tags == {"age": 31, "gender": "female"}
    np.testing.assert_array_equal(found.samples[0].scan, found.samples[0].vertices)
    assert found.samples[1].scan is found.samples[1].vertices


def test_the_folder_and_its_resumption(given, tmp_path, monkeypatch):
    comparison = compare_models(given, out=tmp_path, settings=SETTINGS)
    assert comparison.row("own", "stage1").mean.mean < 1e-3 < 0.05 < comparison.row("weak", "stage1").mean.mean
    assert comparison.row("own", "stage2").mean.mean < 0.05 < comparison.row("weak", "stage2").mean.mean
    assert comparison.specificity_mm["own"][-1][0] == 12 and comparison.unconverged == {"own": 0, "weak": 0}
    page = (tmp_path / PAGE).read_text("utf-8")
    assert "0.748" in page and page.count("<svg") == 4
    with (tmp_path / NUMBERS).open() as file:
        rows = list(csv.DictReader(file))
    kinds = {row["kind"] for row in rows}
    assert {"face", "region", "category", "age", "gender", "optimizer", "density", "specificity"} <= kinds
    assert ComparisonManifest.read(tmp_path / MANIFEST).finished

    def refuse(*_, **__):
        raise AssertionError("a result was computed again")

    (tmp_path / "samples" / "1_00002.npz").write_bytes(b"")
    with pytest.raises(InputError, match="result of a sample"):
        compare_models(given, out=tmp_path, settings=SETTINGS)
    (tmp_path / "samples" / "1_00002.npz").unlink()
    compare_models(given, out=tmp_path, settings=SETTINGS)
    monkeypatch.setattr(workflows.steps.compare, "evaluate_sample", refuse)
    again = compare_models(given, out=tmp_path, settings=SETTINGS)
    assert again.csv() == comparison.csv()
    with pytest.raises(AssertionError):
        compare_models(given, out=tmp_path, settings=replace(SETTINGS, points=201))
    monkeypatch.setattr(workflows.steps.compare, "CODE", workflows.steps.compare.CODE + 1)
    with pytest.raises(AssertionError):
        compare_models(given, out=tmp_path, settings=SETTINGS)


def test_refusals_come_before_the_work(given, tmp_path):
    model = spectrum_model()
    other = replace(model, triangles=model.triangles[::-1].copy())
    gnm_npz.write(other, tmp_path / "other.npz")
    with pytest.raises(InputError, match="no map to the model's topology"):
        compare_models(replace(given, models=(given.models[0], tmp_path / "other.npz")), out=tmp_path / "out")
    with pytest.raises(InputError, match="another topology than the first model"):
        compare_models(replace(given, models=(tmp_path / "other.npz",)), out=tmp_path / "out")
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "notes.txt").write_text("")
    with pytest.raises(InputError):
        compare_models(given, out=tmp_path / "mine")
    with pytest.raises(InputError, match="no registered scans"):
        read_samples(tmp_path)


def nearest_map(source, target) -> TopologyMap:
    """The map between two meshes that lie on one another."""

    def points(a, b) -> SurfacePoints:
        distance, face, share = closest_points(a[0], *b)
        known, zeros = np.ones(len(face), bool), np.zeros((len(face), 3))
        return SurfacePoints(triangle=face, barycentric=share, distance_m=distance, mask=known, offset=zeros)

    still = {"scale": 1.0, "rotation": np.eye(3), "translation": np.zeros(3), "figures": {}}
    topologies = {"source_triangles": source[1], "target_triangles": target[1]}
    return TopologyMap(**topologies, points=points(target, source), back=points(source, target), **still)


@pytest.mark.slow
def test_a_model_of_flames_shape_goes_through(given, tmp_path):
    model = spectrum_model()
    template = model.template_vertex_positions.astype(np.float64)
    marks = read_scheme(FIXTURES / "head_sparse_68.txt", template)
    arrays, scheme = flame_shaped(model, marks)
    write_flame_npz(arrays, tmp_path / "flame.npz", scheme)
    own = template, model.triangles.astype(np.int64)
    map_file.write(nearest_map(own, (arrays["v_template"], arrays["f"].astype(np.int64))), tmp_path / "map.npz")
    with_flame = replace(given, models=(given.models[0], tmp_path / "flame.npz"), maps=(tmp_path / "map.npz",))
    settings = replace(SETTINGS, curve_samples=1, adam=AdamSettings(steps=0))
    comparison = compare_models(with_flame, out=tmp_path / "out", settings=settings)
    assert comparison.models == ("own", "flame")
    first, second = (comparison.row("flame", stage).mean.mean for stage in ("stage1", "stage2"))
    assert comparison.row("own", "stage2").mean.mean < second < 1.1 * first < 2
    assert {curve.part for curve in comparison.curves if curve.model == "flame"} >= {"identity"}
    assert (tmp_path / "out" / PAGE).is_file()


def test_the_command(given, tmp_path, capsys):
    models = [str(path) for path in given.models]
    options = ["--points", "200", "--adam-steps", "0", "--random-heads", "0"]
    options += ["--components", "4", "--jobs", "1"]
    status = main(["model", "compare", *models, "--samples", str(given.samples), "--out", str(tmp_path), *options])
    printed = capsys.readouterr().out
    assert status == 0
    assert "own, stage2: mean" in printed and str(Path(tmp_path) / NUMBERS) in printed
