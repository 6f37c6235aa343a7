"""Evaluation of models: known metrics, gains, tables, refused input, and subjects of the synthetic population."""

import json
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from coregister.evaluate import evaluation
from coregister.evaluate.evaluation import EvaluationSettings, HeldOutSubject, evaluate
from coregister.first_model import population
from coregister.synthetic import expressions
from registration.errors import InputError
from registration.model import gnm_npz, regions
from registration.storage.hashing import to_jsonable
from tests.conftest import SHARED, needs_shared
from tests.coregister.spectrum import DEVIATIONS_MM, heads, spectrum_model, with_identity

SETTINGS = EvaluationSettings(components=(2, 4, 8), samples=5, draws=500)
AGES = (25, 31, 38, 64)


@pytest.fixture(scope="module")
def model():
    return spectrum_model()


def random_subjects(model, count=4, seed=0):
    """Random heads of the model with two expressions, tags and a scan each."""
    rng = np.random.default_rng(seed)
    subjects = []
    for number in range(count):
        neutral = heads(model, rng.standard_normal((1, len(model.vertex_identity_basis))))[0]
        displacements = np.tensordot(rng.standard_normal((2, 12)), model.expression_basis, 1)
        subjects.append(
            HeldOutSubject(
                subject=f"subject_{number}",
                neutral=neutral,
                expressions=neutral + displacements,
                categories=("jaw", "lips"),
                tags={
                    "gender": ("female", "male")[number % 2],
                    "age": AGES[number % 4],
                    "category": "neutral",
                    "note": f"{number}",
                },
                scan=neutral[regions.head_skin(model)],
            )
        )
    return subjects


@pytest.fixture(scope="module")
def result(model):
    return evaluate({"own": model}, random_subjects(model), model.triangles, SETTINGS)


def test_a_model_on_its_own_samples(model, result):
    own = result.models["own"]
    assert own.identity.components == (2, 4, 8, 12)
    assert own.identity.at_components(12).max() < 1e-6
    means = [interval.mean for interval in own.identity.intervals]
    assert means == sorted(means, reverse=True)
    assert own.expressions["lower_face"].at_components(12).max() < 1e-6
    assert own.scans is not None and own.scans.at_components(12).max() < 1e-2
    assert (
        own.scans.at_components(2) <= own.identity.at_components(2) + 1e-9
    ).all()  # the surface is at most as far as the vertex
    assert own.unconverged == 0
    skin = regions.head_skin(model)
    assert own.vertex_mm[skin].mean() == pytest.approx(own.identity.at_components(8).mean())
    assert np.isnan(own.vertex_mm[~skin]).all()
    share = np.cumsum(DEVIATIONS_MM**2) / (DEVIATIONS_MM**2).sum()
    np.testing.assert_allclose(own.compactness["identity"].share, share, rtol=1e-6)
    assert own.compactness["identity"].rms_mm[-1] == pytest.approx(np.sqrt((DEVIATIONS_MM**2).sum()), rel=1e-6)
    assert result.vertices == regions.head_skin(model).sum()


def test_metrics_do_not_depend_on_the_subjects_poses(model, result):
    rotations = Rotation.random(4, random_state=1)
    transformed = []
    for rotation, subject in zip(rotations, random_subjects(model), strict=True):

        def transform(points, rotation=rotation):
            return (rotation.apply(points.reshape(-1, 3)) + (0.5, 1.0, -2.0)).reshape(points.shape)

        transformed.append(
            replace(
                subject,
                neutral=transform(subject.neutral),
                expressions=transform(subject.expressions),
                scan=transform(subject.scan),
            )
        )
    again = evaluate({"own": model}, transformed, model.triangles, SETTINGS).models["own"]
    own = result.models["own"]
    np.testing.assert_allclose(again.identity.values_mm, own.identity.values_mm, atol=1e-6)
    np.testing.assert_allclose(again.scans.values_mm, own.scans.values_mm, rtol=2e-2, atol=1e-2)
    np.testing.assert_allclose(
        again.expressions["lower_face"].values_mm, own.expressions["lower_face"].values_mm, atol=1e-6
    )
    np.testing.assert_allclose(again.specificity.values_mm, own.specificity.values_mm, atol=1e-4)
    for row, other in zip(own.rows, again.rows, strict=True):
        assert (row.kind, row.name, row.subjects) == (other.kind, other.name, other.subjects)
        assert row.distance_mm.mean == pytest.approx(other.distance_mm.mean, abs=1e-6)


def test_tables_group_subjects_by_region_category_and_tag(model, result):
    own = result.models["own"]
    rows = {(row.kind, row.name): row for row in own.rows}
    assert {name for kind, name in rows if kind == "category"} == {"neutral", "jaw", "lips"}
    assert {name for kind, name in rows if kind == "age"} == {"20-29", "30-39", "60-69"}
    assert rows["age", "30-39"].subjects == 2 and rows["age", "20-29"].subjects == 1
    assert rows["age", "20-29"].distance_mm.low is None
    assert "note" not in {kind for kind, _ in rows}  # the note differs for every subject
    neutrals = own.identity.at_components(8)
    assert rows["gender", "female"].distance_mm.mean == pytest.approx(neutrals[::2].mean())
    assert rows["gender", "male"].distance_mm.mean == pytest.approx(neutrals[1::2].mean())
    assert rows["category", "jaw"].distance_mm.mean < 1e-6  # all components: the model's own samples
    parts = [row for (kind, _), row in rows.items() if kind == "region"]
    assert parts and all(row.subjects == 4 and row.distance_mm.mean > 0 for row in parts)


def test_gains_are_paired_and_of_the_same_number_of_components(model):
    """The first model lacks the first component: its k components leave the residual of k + 1, and the first."""
    weak = with_identity(model, np.roll(model.vertex_identity_basis, -1, 0))
    subjects = [replace(subject, scan=None) for subject in random_subjects(model, 12, seed=2)]
    settings = replace(SETTINGS, samples=0)
    result = evaluate({"weak": weak, "own": model, "same": weak}, subjects, model.triangles, settings)
    assert [(gain.model, gain.components) for gain in result.gains] == [
        (name, k) for name in ("own", "same") for k in (2, 4, 8)
    ]
    for gain in result.gains[:3]:
        first, other = (result.models[name].identity.at_components(gain.components) for name in ("weak", "own"))
        assert gain.gain.mean == pytest.approx(1 - other.mean() / first.mean())
        assert gain.gain.low < gain.gain.mean < gain.gain.high
        assert gain.difference_mm.mean == pytest.approx(first.mean() - other.mean())
    assert result.gains[2].gain.low > 0.3
    for gain in result.gains[3:]:
        assert gain.gain.mean == pytest.approx(0, abs=1e-9) and gain.gain.high == pytest.approx(0, abs=1e-9)
    assert result.models["own"].specificity is None


def test_metrics_are_deterministic_and_serializable(model, result):
    again = evaluate({"own": model}, random_subjects(model), model.triangles, SETTINGS)
    text = json.dumps(to_jsonable(result.metrics), allow_nan=False)
    assert text == json.dumps(to_jsonable(again.metrics), allow_nan=False)
    other = evaluate({"own": model}, random_subjects(model), model.triangles, replace(SETTINGS, seed=1))
    assert other.models["own"].specificity.values_mm.tolist() != result.models["own"].specificity.values_mm.tolist()


def test_subjects_without_scans_or_expressions_have_no_such_metrics(model):
    bare = [
        replace(subject, scan=None, expressions=subject.expressions[:0], categories=())
        for subject in random_subjects(model)
    ]
    own = evaluate({"own": model}, bare, model.triangles, SETTINGS).models["own"]
    assert own.scans is None and own.expressions == {}
    mixed = [random_subjects(model)[0], *bare[1:]]
    own = evaluate({"own": model}, mixed, model.triangles, SETTINGS).models["own"]
    assert own.scans.intervals[0].low is None and np.isnan(own.scans.values_mm[1:]).all()
    assert len(own.expressions["lower_face"].intervals) == 4


def with_value(subject, value):
    neutral = subject.neutral.copy()
    neutral[5, 1] = value
    return replace(subject, neutral=neutral)


INVALID = {
    "no subjects": (lambda m, p, s: ({"m": m}, [], m.triangles, s), "too few held-out"),
    "one subject": (lambda m, p, s: ({"m": m}, p[:1], m.triangles, s), "too few held-out"),
    "a subject twice": (lambda m, p, s: ({"m": m}, [p[0], p[0]], m.triangles, s), "comes twice"),
    "no model": (lambda m, p, s: ({}, p, m.triangles, s), "no model"),
    "different topology": (lambda m, p, s: ({"m": m}, p, m.triangles[:, ::-1], s), "another topology"),
    "NaN": (lambda m, p, s: ({"m": m}, [with_value(p[0], np.nan), *p[1:]], m.triangles, s), "not finite"),
    "infinite": (lambda m, p, s: ({"m": m}, [with_value(p[0], np.inf), *p[1:]], m.triangles, s), "not finite"),
    "fewer vertices": (
        lambda m, p, s: (
            {"m": m},
            [replace(p[0], neutral=p[0].neutral[:-1], expressions=p[0].expressions[:, :-1]), *p[1:]],
            m.triangles,
            s,
        ),
        "another size",
    ),
    "categories missing": (
        lambda m, p, s: ({"m": m}, [replace(p[0], categories=()), *p[1:]], m.triangles, s),
        "categories are incomplete",
    ),
    "an empty scan": (
        lambda m, p, s: ({"m": m}, [replace(p[0], scan=np.zeros((0, 3))), *p[1:]], m.triangles, s),
        "scan is empty",
    ),
    "too many components": (
        lambda m, p, s: ({"m": m}, p, m.triangles, replace(s, components=(2, 13))),
        "fewer identity components",
    ),
    "components out of order": (
        lambda m, p, s: ({"m": m}, p, m.triangles, replace(s, components=(4, 2))),
        "out of order",
    ),
    "no components": (lambda m, p, s: ({"m": m}, p, m.triangles, replace(s, components=())), "out of order"),
    "a negative number of samples": (
        lambda m, p, s: ({"m": m}, p, m.triangles, replace(s, samples=-1)),
        "out of range",
    ),
}


@pytest.mark.parametrize("name", INVALID)
def test_invalid_input_is_refused_before_any_computation(model, name, monkeypatch):
    def never(*_, **__):
        raise AssertionError("computation has started")

    monkeypatch.setattr(evaluation.linear_fit, "fit_correspondence", never)
    make, what = INVALID[name]
    with pytest.raises(InputError) as error:
        evaluate(*make(model, random_subjects(model), SETTINGS))
    assert what in error.value.what
    assert all((error.value.where, error.value.expected, error.value.got, error.value.fix))


@needs_shared
@pytest.mark.slow
def test_a_model_of_the_official_size_on_its_own_samples():
    data = gnm_npz.read(SHARED / "data" / "gnm" / "gnm_head_reconstructed.npz")
    rng = np.random.default_rng(0)
    members = np.concatenate([members for members, _ in regions.expression_regions(data).values()])
    subjects = []
    for number in range(2):
        neutral = heads(data, rng.standard_normal((1, len(data.vertex_identity_basis))))[0]
        displacement = np.tensordot(
            rng.standard_normal(len(members)), data.expression_basis[members].astype(np.float64), 1
        )
        both = {"expressions": (neutral + displacement)[None], "categories": ("any",)}
        subjects.append(HeldOutSubject(subject=f"{number}", neutral=neutral, **both))
    settings = EvaluationSettings(components=(10, 20, 40), samples=0)
    result = evaluate({"own": data}, subjects, data.triangles, settings).models["own"]
    means = [interval.mean for interval in result.identity.intervals]
    assert result.unconverged == 0 and means == sorted(means, reverse=True)
    assert means[0] > 0.2 and means[-1] < 1e-5
    rows = {(row.kind, row.name): row.distance_mm.mean for row in result.rows}
    assert rows["category", "any"] < 1e-5 and rows["category", "neutral"] < 1e-5


@pytest.mark.slow
def test_subjects_outside_the_first_models_span(head_assembly, model, model_file):
    data, source = gnm_npz.read(model_file), head_assembly.source
    rng = np.random.default_rng(12345)
    performed = [expressions.expression_by_name(name) for name in ("smile", "jaw_open", "brows_up")]

    def subject(number, draw):
        person = draw(source, rng)
        neutral, joints = head_assembly.assemble(person, {name: source.target(name) for name in person.weights})
        meshes = np.stack([expressions.apply_expression(head_assembly, each, neutral, joints) for each in performed])
        return HeldOutSubject(
            subject=f"{draw.__name__}_{number}",
            neutral=neutral,
            expressions=meshes,
            categories=tuple(expression.category for expression in performed),
            tags=person.tags,
        )

    settings = EvaluationSettings(components=(10, 20, 40), samples=0)
    means = {}
    for draw in (population.sample_spanned_person, population.sample_unspanned_person):
        result = evaluate({"first": data}, [subject(k, draw) for k in range(8)], data.triangles, settings)
        metrics = result.models["first"]
        means[draw.__name__] = [interval.mean for interval in metrics.identity.intervals]
        assert metrics.unconverged == 0
        for region in ("left_eye", "right_eye", "lower_face"):
            assert metrics.expressions[region].intervals[-1].mean < 0.15
    spanned, unspanned = means["sample_spanned_person"], means["sample_unspanned_person"]
    assert spanned[-1] < 0.6  # 99.5 % of the variance leave 0.41 mm rms of the basis' own samples
    assert unspanned[1] > 1.2 and unspanned[-1] > 1.5 * spanned[-1]
