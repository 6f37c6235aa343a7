"""Model building: the model file, its manifest, recipes, and input that is refused."""

import json
from dataclasses import fields, replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from bench.support.population import true_neutrals
from coregister.anatomy.cranium_model import build_cranium_model, under_hair
from coregister.first_model.build import TargetDisplacements
from coregister.next_model import provenance
from coregister.next_model.alignment import align_neutrals
from coregister.next_model.build import BuiltModel, _align, build_model
from coregister.next_model.expression import ExpressionSettings
from coregister.next_model.recipes import ModelRecipe, few_registrations, load_model_recipe, true_meshes
from coregister.next_model.size import check_disk, check_recipe
from coregister.next_model.training_data import TrainingSubject, validate_training_set
from registration.cranium.auxiliary_model import CraniumModel
from registration.errors import InputError
from registration.frames import transform_points
from registration.geometry import rigid
from registration.model import gnm_npz, landmarks, regions
from registration.model.gnm_npz import AXES, GNMData
from tests.conftest import SHARED, needs_shared
from tests.coregister.next_model import samples

EXPRESSIONS = ("smile", "jaw_open", "wink_left", "brows_up")
CATEGORIES = {"smile": "flexing", "jaw_open": "jaw", "wink_left": "eyes", "brows_up": "eyebrows"}


def with_identity(**settings) -> ModelRecipe:
    recipe = few_registrations()
    return replace(recipe, name="own", identity=replace(recipe.identity, **settings))


def own_recipe() -> ModelRecipe:
    return with_identity(max_components=7)


@pytest.fixture(scope="module")
def subjects(head_assembly, model) -> list[TrainingSubject]:
    return samples.subjects(head_assembly, model, range(500, 508), EXPRESSIONS)


@pytest.fixture(scope="module")
def built(subjects, model) -> BuiltModel:
    return build_model(subjects, model, true_meshes(), categories=CATEGORIES)


@pytest.fixture(scope="module")
def files(built: BuiltModel, model_file: Path, tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("built") / "next.npz"
    provenance.write(built.data, built.manifest, built.coefficients, path, model_file)
    return path


def test_all_23_fields_come_back_from_the_file(built: BuiltModel, files: Path, model):
    again = gnm_npz.read(files)
    assert len(AXES) == 23
    for name in AXES:
        first, second, previous = (getattr(data, name) for data in (built.data, again, model))
        assert first.dtype == second.dtype and first.shape == second.shape and np.array_equal(first, second)
        assert first.dtype.kind == previous.dtype.kind and first.ndim == previous.ndim
        assert first.dtype == previous.dtype or first.dtype.kind == "U"
    assert gnm_npz.content_hash(again) == built.manifest["content_id"]
    sizes = [len(getattr(again, name)) for name in ("identity_names", "expression_names")]
    assert sizes == [len(again.vertex_identity_basis), len(again.expression_basis)]


def test_everything_else_is_the_previous_models(built: BuiltModel, model):
    rebuilt = ("template", "identity", "expression", "joint_regressor")
    for field in fields(GNMData):
        if not any(word in field.name for word in rebuilt) and field.name != "extra":
            assert np.array_equal(getattr(built.data, field.name), getattr(model, field.name)), field.name
    names, old = built.data.expression_names.tolist(), model.expression_names.tolist()
    for name in [n for n in old if n.startswith(("tongue", "pupils"))]:
        assert np.array_equal(built.data.expression_basis[names.index(name)], model.expression_basis[old.index(name)])
    names, old = built.data.identity_names.tolist(), model.identity_names.tolist()
    assert [n for n in names if n.startswith("eye")] == ["eye_000", "eye_001", "eye_002"]
    assert np.array_equal(built.data.vertex_identity_basis[-3:], model.vertex_identity_basis[-3:])


def test_the_built_model_is_symmetric_and_its_regressor_gives_its_joints(built: BuiltModel):
    data = built.data
    for symmetric in (data.template_vertex_positions, data.template_joint_positions):
        mirror_images = symmetric[[0, 1, 3, 2] if len(symmetric) == 4 else data.mirror_indices] * (-1, 1, 1)
        assert np.abs(mirror_images - symmetric).max() <= 1e-7
    left, right = (
        data.expression_basis[[n.startswith(f"{side}_eye_region") for n in data.expression_names.tolist()]]
        for side in ("left", "right")
    )
    assert len(left) and np.abs(right - left[:, data.mirror_indices] * (-1, 1, 1)).max() <= 1e-7
    positions = data.joint_regressor @ data.template_vertex_positions
    assert np.abs(positions - data.template_joint_positions).max() < 1e-6
    basis = np.einsum("jv,kvc->kjc", data.joint_regressor, data.vertex_identity_basis[:-3])
    assert np.abs(basis - data.joint_identity_basis[:-3]).max() < 1e-6
    # The eye joints move with the eyeballs.
    for side, ball in enumerate(regions.eyeballs(data)):
        translation = data.vertex_identity_basis[:-3][:, ball].mean(1)
        assert np.abs(translation - data.joint_identity_basis[:-3, 2 + side]).max() < 1e-6


def _residual_mm(data: GNMData, basis: np.ndarray, targets: list[np.ndarray]) -> float:
    """rms residual of displacements from a basis over the skin, by least squares."""
    skin = regions.exterior(data)
    flat = basis[:, skin].reshape(len(basis), -1).astype(np.float64).T
    right = np.stack([target[skin].ravel() for target in targets], 1).astype(np.float64)
    residual = right - flat @ np.linalg.lstsq(flat, right, rcond=None)[0]
    return float(1e3 * np.sqrt(3 * np.mean(residual**2)))


def test_the_built_model_represents_its_training_data(built: BuiltModel, subjects, model):
    """Neutrals better than the previous model with as many components; expressions to 99 % of their energy."""
    heads = np.stack([subject.neutral.vertices for subject in subjects])
    aligned = align_neutrals(heads, np.ones(heads.shape[:2], np.float32), [s.name for s in subjects], model)
    displacements = [mesh.vertices - subject.neutral.vertices for subject in subjects for mesh in subject.expressions]
    residual_mm = {}
    for name, data in (("previous", model), ("next", built.data)):
        count = np.array(built.manifest["identity"]["components"])
        deviations = [head - data.template_vertex_positions for head in aligned.vertices]
        residual_mm[name] = (
            _residual_mm(data, data.vertex_identity_basis[:count], deviations),
            _residual_mm(data, data.expression_basis, displacements),
        )
    print(f"identity, expression: {residual_mm} mm")
    assert residual_mm["next"][0] < 0.5 * residual_mm["previous"][0]
    # Every region keeps its fraction of the energy; transitions between regions a little less.
    energy = _residual_mm(built.data, np.zeros((1, *displacements[0].shape)), displacements) ** 2
    assert residual_mm["next"][1] ** 2 < 0.012 * energy


def test_the_manifest_contains_inputs_settings_and_metrics(built: BuiltModel, files: Path, subjects, model):
    manifest = json.loads(files.with_name("next.manifest.json").read_text())
    assert manifest == built.manifest
    assert [s["subject"] for s in manifest["subjects"]] == [s.name for s in subjects] and manifest["rejected"] == []
    assert {s["expressions"] for s in manifest["subjects"]} == {4} and manifest["subjects"][0]["weight_of_each"] == 0.25
    assert manifest["inputs"]["previous"] == gnm_npz.content_hash(model) and len(manifest["inputs"]) == 8 * 5 + 2
    assert manifest["identity"]["share_previous"] == 0.2 and 0.99 <= manifest["identity"]["share_kept"] <= 1
    assert manifest["identity"]["samples"] == 16 and manifest["identity"]["weight_of_each"] == 0.5
    assert manifest["identity"]["shares_tried_mm"] == {} and manifest["config"]["identity"]["mirrored"] is True
    assert manifest["identity"]["carried"] == ["eye_000", "eye_001", "eye_002"]
    assert manifest["categories"] == dict.fromkeys(sorted(CATEGORIES.values()), 8)
    assert sum(manifest["demographics"]["age"].values()) == 8 and manifest["demographics"]["gender"] == {
        "female": 4,
        "male": 4,
    }
    assert manifest["figures"]["lid_gap_change_mm"]["worst"] < 0.2 and 0 < manifest["figures"]["drift_mm"] < 10
    assert manifest["versions"]["numpy"] == np.__version__ and manifest["config"]["identity"]["shrinkage"] == 0.2


def test_coefficients_and_landmark_schemes_are_written_beside_the_file(built: BuiltModel, files: Path):
    with np.load(files.with_name("next.expressions.npz")) as arrays:
        names, mean, covariance = arrays["names"], arrays["mean"], arrays["covariance"]
    assert names.tolist() == built.data.expression_names[: len(names)].tolist()
    assert mean.shape == (len(names),) and covariance.shape == (len(names),) * 2
    assert np.linalg.eigvalsh(covariance).min() > -1e-9
    assert sorted(landmarks.schemes_beside(files, built.data.template_vertex_positions)) == ["68", "dense", "oral"]


def test_building_is_deterministic(built: BuiltModel, subjects, model):
    again = build_model(_Reread(subjects), model, true_meshes(), categories=CATEGORIES)
    assert again.manifest == built.manifest


class _Reread:
    """Subjects that are iterated again each time, as when they are read from disk."""

    def __init__(self, subjects: list[TrainingSubject]):
        self._subjects = subjects

    def __iter__(self):
        return iter(list(self._subjects))


def test_a_built_model_can_be_the_previous_model(built: BuiltModel, subjects):
    again = build_model(subjects[:5], built.data)
    for names in (again.data.identity_names.tolist(), again.data.expression_names.tolist()):
        assert len(set(names)) == len(names)
    assert again.data.identity_names.tolist()[-3:] == ["eye_000", "eye_001", "eye_002"]
    assert again.data.expression_names.tolist()[-1] == built.data.expression_names.tolist()[-1] == "pupils_000"
    assert again.manifest["inputs"]["previous"] == built.manifest["content_id"]
    # Regressors that are rebuilt round after round keep the joints.
    first, second = built.data, again.data
    positions = second.joint_regressor @ first.template_vertex_positions
    assert 1e3 * np.abs(positions - first.template_joint_positions).max() < 0.5


def test_shrinkage_is_cross_validated_and_reported(subjects, model):
    neutrals = [replace(subject, expressions=()) for subject in subjects]
    manifest = build_model(neutrals, model, with_identity(max_components=10)).manifest["identity"]
    scores = {float(shrinkage): rms for shrinkage, rms in manifest["shares_tried_mm"].items()}
    assert len(scores) == 20 and manifest["share_previous"] == min(scores, key=scores.__getitem__)
    assert manifest["components"] == 10 and 0 < scores[manifest["share_previous"]] < scores[0.0] < 10


def test_the_share_chosen_does_not_climb_from_round_to_round(subjects, model):
    """Three rounds with the same registrations: the prior has seen none of the subjects, the previous models have."""
    neutrals = [replace(subject, expressions=()) for subject in subjects]
    previous, shares, leaking = model, [], []
    for _ in range(3):
        built = build_model(neutrals, previous, with_identity(max_components=10), prior=model)
        leaking.append(build_model(neutrals, previous, with_identity(max_components=10)).manifest["identity"])
        shares.append(built.manifest["identity"]["share_previous"])
        assert built.manifest["inputs"]["prior"] == gnm_npz.content_hash(model)
        previous = built.data
    print(shares, [identity["share_previous"] for identity in leaking])
    assert max(shares) - min(shares) <= 0.05 + 1e-9 and shares[0] == leaking[0]["share_previous"]
    assert leaking[2]["share_previous"] > shares[2]  # what it would do towards the previous model


def test_without_expressions_the_previous_basis_is_kept(subjects, model):
    built = build_model([replace(subject, expressions=()) for subject in subjects], model)
    assert np.array_equal(built.data.expression_basis, model.expression_basis)
    assert built.coefficients is None and "previous" in built.manifest["expression"]


def test_outliers_are_rejected_by_name(subjects, model):
    rng = np.random.default_rng(0)
    damaged = list(subjects)
    noise = rng.normal(0, 2e-3, subjects[2].neutral.vertices.shape)
    damaged[2] = replace(subjects[2], neutral=samples.mesh("neutral", subjects[2].neutral.vertices + noise, model))
    bad = samples.mesh("smile", subjects[5].expressions[0].vertices + noise, model)
    damaged[5] = replace(subjects[5], expressions=(bad, *subjects[5].expressions[1:]))
    built = build_model(damaged, model)
    names = [row["name"] for row in built.manifest["rejected"]]
    assert names == [subjects[2].name, f"{subjects[5].name}, smile"]
    rows = {row["subject"]: row for row in built.manifest["subjects"]}
    assert len(rows) == 7 and rows[subjects[5].name]["expressions"] == 3
    assert rows[subjects[5].name]["weight_of_each"] == pytest.approx(1 / 3)


def test_an_auxiliary_model_completes_unobserved_craniums(head_assembly, subjects, model):
    hair = under_hair(model)
    displacements = TargetDisplacements(head_assembly.source)
    heads = true_neutrals(head_assembly, displacements, 40, np.random.default_rng(600))
    cranium = build_cranium_model(model, heads, seed=0, source="samples", ranks=(20,), noises_mm=(2.0,))
    partial = []
    for subject in subjects:
        vertices = subject.neutral.vertices + np.float32(0.05) * hair[:, None]
        partial.append(replace(subject, neutral=samples.mesh("neutral", vertices, model, ~hair), expressions=()))

    def error_mm(recipe: ModelRecipe, cranium: CraniumModel | None) -> float:
        training = validate_training_set(partial, model)
        aligned, completed = _align(training, model, recipe, cranium)
        assert completed == len(subjects)
        truths = np.stack([subjects[k].neutral.vertices for k in aligned.kept]).astype(np.float64)
        T = rigid.align(
            truths, model.template_vertex_positions, np.tile((~hair & regions.head_skin(model)).astype(float), (8, 1))
        )
        moved = np.stack([transform_points(t, vertices) for t, vertices in zip(T, truths, strict=True)])
        return float(1e3 * np.linalg.norm(aligned.vertices - moved, axis=2)[:, hair].mean())

    recipe = few_registrations()
    off = replace(recipe, completion=replace(recipe.completion, cranium="off"))
    assert error_mm(off, cranium) == error_mm(recipe, None)
    assert error_mm(recipe, cranium) < 0.8 * error_mm(recipe, None)


def test_unobserved_skin_follows_the_previous_model(subjects, model):
    behind = model.template_vertex_positions[:, 2] < -0.02
    partial = []
    for subject in subjects:
        vertices = subject.neutral.vertices + np.float32(0.05) * behind[:, None]
        partial.append(replace(subject, neutral=samples.mesh("neutral", vertices, model, ~behind), expressions=()))
    built = build_model(partial, model)
    clean = build_model([replace(subject, expressions=()) for subject in subjects], model)
    difference = np.linalg.norm(built.data.template_vertex_positions - clean.data.template_vertex_positions, axis=1)
    skin = regions.exterior(model)
    unobserved, observed = (difference[skin & part].mean() for part in (behind, ~behind))
    print(f"unobserved {1e3 * unobserved:.2f} mm, observed {1e3 * observed:.2f} mm off")
    assert unobserved < 6e-3 and observed < 1e-3
    assert built.manifest["filled"] == {"neutrals": 8, "expressions": 0}


def test_recipes_load_by_name_by_import_path_and_from_json():
    assert load_model_recipe("few_registrations") == few_registrations() == load_model_recipe(few_registrations())
    assert load_model_recipe(f"{__name__}:own_recipe").identity.max_components == 7
    for recipe in (few_registrations(), true_meshes(), own_recipe()):
        assert ModelRecipe.from_json(json.loads(json.dumps(recipe.to_json())), where="here") == recipe
    with pytest.raises(InputError, match="model recipe") as caught:
        load_model_recipe("many")
    assert "few_registrations" in caught.value.expected
    with pytest.raises(InputError) as caught:
        ModelRecipe.from_json({**few_registrations().to_json(), "shrinkage": 0.5}, where="here")
    assert "shrinkage" in caught.value.where


def _nan(subject: TrainingSubject) -> TrainingSubject:
    vertices = subject.neutral.vertices.copy()
    vertices[7, 1] = np.nan
    return replace(subject, neutral=replace(subject.neutral, vertices=vertices))


def _foreign(subject: TrainingSubject) -> TrainingSubject:
    triangles = subject.neutral.triangles[:, [1, 0, 2]]
    return replace(subject, neutral=replace(subject.neutral, triangles=triangles))


def _fewer(subject: TrainingSubject) -> TrainingSubject:
    mesh = subject.expressions[1]
    mesh = replace(mesh, vertices=mesh.vertices[:-1], confidence=mesh.confidence[:-1])
    return replace(subject, expressions=(subject.expressions[0], mesh))


def _out_of_range(subject: TrainingSubject) -> TrainingSubject:
    return replace(subject, neutral=replace(subject.neutral, confidence=2 * subject.neutral.confidence))


def _unknown(subject: TrainingSubject) -> TrainingSubject:
    return replace(subject, expressions=(replace(subject.expressions[0], label="sneeze"),))


@pytest.mark.parametrize(
    "damage, what, got",
    [
        (lambda s: replace(s, neutral=None), "no neutral", "4 expressions"),
        (_nan, "not finite", "1 NaN"),
        (_foreign, "another topology", "another order"),
        (_fewer, "another topology", "21912 vertices"),
        (_out_of_range, "out of range", "2.0"),
        (_unknown, "label is unknown", "sneeze"),
    ],
)
def test_invalid_subjects_are_refused_by_name(subjects, model, damage, what, got):
    with pytest.raises(InputError) as caught:
        build_model([*subjects[:3], damage(subjects[3])], model, categories=CATEGORIES)
    assert what in caught.value.what and subjects[3].name in caught.value.where and got in caught.value.got
    assert caught.value.expected and caught.value.fix


def test_too_few_samples_are_refused(subjects, model):
    with pytest.raises(InputError, match="too few neutrals"):
        build_model(subjects[:1], model)
    with pytest.raises(InputError, match="no samples|too few neutrals"):
        build_model([], model)
    with pytest.raises(InputError, match="rank") as caught:
        build_model(subjects[:4], model, with_identity(max_components=4, shrinkage=0.0, mirrored=False))
    assert caught.value.got == "4" and "4 neutrals about" in caught.value.expected
    with pytest.raises(InputError, match="rank") as caught:
        build_model(subjects[:4], model, with_identity(max_components=8, shrinkage=0.0))
    assert caught.value.got == "8" and "4 neutrals and their mirror images" in caught.value.expected
    with pytest.raises(InputError, match="twice"):
        build_model([subjects[0], subjects[0]], model)


def test_what_cannot_be_built_is_refused_before_it_is_registered(model, monkeypatch):
    paper = 5000, 150_000
    check_recipe(*paper, model, few_registrations())  # a sketch
    with pytest.raises(InputError, match="no room") as caught:
        many = ExpressionSettings(max_components={"lower_face_region": 4000})
        check_recipe(*paper, model, replace(few_registrations(), expressions=many))
    assert "memory_gb" in caught.value.where and "4000 components" in caught.value.expected
    with pytest.raises(InputError, match="rank"):
        check_recipe(4, 0, model, with_identity(max_components=8, shrinkage=0.0))
    check_disk(10, len(model.template_vertex_positions))
    monkeypatch.setattr("shutil.disk_usage", lambda _: SimpleNamespace(free=10**9))
    with pytest.raises(InputError, match="disk") as caught:
        check_disk(150_000, len(model.template_vertex_positions))
    assert "39.4 GB" in caught.value.expected and "TMPDIR" in caught.value.fix


@needs_shared
def test_data_types_of_the_previous_model_are_kept(tmp_path: Path):
    """Such as float16 bases. Neutrals are random heads of the file itself."""
    model = gnm_npz.read(SHARED / "data" / "gnm" / "gnm_head_reconstructed.npz")
    rng = np.random.default_rng(0)
    heads = samples.heads(model, rng.normal(size=(6, len(samples.head_components(model)))))
    subjects = [
        TrainingSubject(name=str(k), neutral=samples.mesh("neutral", head, model)) for k, head in enumerate(heads)
    ]
    built = build_model(subjects, model)
    gnm_npz.write(built.data, tmp_path / "next.npz")
    again = gnm_npz.read(tmp_path / "next.npz")
    assert gnm_npz.content_hash(again) == built.manifest["content_id"]
    assert again.vertex_identity_basis.dtype == model.vertex_identity_basis.dtype == np.float16
    assert built.manifest["figures"]["lid_gap_change_mm"]["worst"] < 0.2
