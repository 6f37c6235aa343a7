"""A model out of registrations: the file, its manifest, and everything that is refused before any work."""

import json
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
import torch

from coregister.next_model import provenance
from coregister.next_model.alignment import align_neutrals
from coregister.next_model.build import BuiltModel, build_model
from coregister.next_model.recipes import ModelRecipe, few_registrations, load_model_recipe, true_meshes
from coregister.next_model.training_data import TrainingSubject, unpose
from registration.errors import InputError
from registration.frames import axis_angle_to_matrix
from registration.model import gnm_npz, landmarks, regions
from registration.model.gnm import GNM
from registration.model.gnm_npz import AXES, GNMData
from registration.types import Parameters, Registration
from tests.conftest import SHARED, needs_shared
from tests.coregister.next_model import known

ACTS = ("smile", "jaw_open", "wink_left", "brows_up")
CATEGORIES = {"smile": "flexing", "jaw_open": "jaw", "wink_left": "eyes", "brows_up": "eyebrows"}


def with_identity(**settings) -> ModelRecipe:
    recipe = few_registrations()
    return replace(recipe, name="own", identity=replace(recipe.identity, **settings))


def own_recipe() -> ModelRecipe:
    return with_identity(max_components=7)


@pytest.fixture(scope="module")
def subjects(anatomy, model) -> list[TrainingSubject]:
    return known.people(anatomy, model, range(500, 508), ACTS)


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
        one, two, old = (getattr(data, name) for data in (built.data, again, model))
        assert one.dtype == two.dtype and one.shape == two.shape and np.array_equal(one, two)
        assert one.dtype.kind == old.dtype.kind and one.ndim == old.ndim
        assert one.dtype == old.dtype or one.dtype.kind == "U"
    assert gnm_npz.content_hash(again) == built.manifest["content_id"]
    sizes = [len(getattr(again, name)) for name in ("identity_names", "expression_names")]
    assert sizes == [len(again.vertex_identity_basis), len(again.expression_basis)]


def test_what_is_not_built_is_the_previous_models(built: BuiltModel, model):
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


def test_the_built_model_is_symmetric_mirrors_its_eyes_and_tells_its_joints(built: BuiltModel):
    data = built.data
    for symmetric in (data.template_vertex_positions, data.template_joint_positions):
        twins = symmetric[[0, 1, 3, 2] if len(symmetric) == 4 else data.mirror_indices] * (-1, 1, 1)
        assert np.abs(twins - symmetric).max() <= 1e-7
    left, right = (
        data.expression_basis[[n.startswith(f"{side}_eye_region") for n in data.expression_names.tolist()]]
        for side in ("left", "right")
    )
    assert len(left) and np.abs(right - left[:, data.mirror_indices] * (-1, 1, 1)).max() <= 1e-7
    told = data.joint_regressor @ data.template_vertex_positions
    assert np.abs(told - data.template_joint_positions).max() < 1e-6
    told = np.einsum("jv,kvc->kjc", data.joint_regressor, data.vertex_identity_basis[:-3])
    assert np.abs(told - data.joint_identity_basis[:-3]).max() < 1e-6
    # Eyeballs turn about joints that went with them.
    for side, ball in enumerate(regions.eyeballs(data)):
        moved = data.vertex_identity_basis[:-3][:, ball].mean(1)
        assert np.abs(moved - data.joint_identity_basis[:-3, 2 + side]).max() < 1e-6


def _off_mm(data: GNMData, basis: np.ndarray, targets: list[np.ndarray]) -> float:
    """rms over the skin of what least squares leave of displacements."""
    skin = regions.exterior(data)
    flat = basis[:, skin].reshape(len(basis), -1).astype(np.float64).T
    wanted = np.stack([target[skin].ravel() for target in targets], 1).astype(np.float64)
    left = wanted - flat @ np.linalg.lstsq(flat, wanted, rcond=None)[0]
    return float(1e3 * np.sqrt(3 * np.mean(left**2)))


def test_the_built_model_holds_what_it_was_built_from(built: BuiltModel, subjects, model):
    """Neutrals, aligned as for the build, against the previous model with as many components; 99 % of expressions."""
    heads = np.stack([subject.neutral.vertices for subject in subjects])
    aligned = align_neutrals(heads, np.ones(heads.shape[:2], np.float32), [s.name for s in subjects], model)
    acts = [mesh.vertices - subject.neutral.vertices for subject in subjects for mesh in subject.expressions]
    off = {}
    for name, data in (("previous", model), ("next", built.data)):
        own = np.array(built.manifest["identity"]["components"])
        away = [head - data.template_vertex_positions for head in aligned.vertices]
        off[name] = _off_mm(data, data.vertex_identity_basis[:own], away), _off_mm(data, data.expression_basis, acts)
    print(f"identity, expression: {off} mm")
    assert off["next"][0] < 0.5 * off["previous"][0]
    # Each region keeps its share, and the blends between them a little less.
    energy = _off_mm(built.data, np.zeros((1, *acts[0].shape)), acts) ** 2
    assert off["next"][1] ** 2 < 0.012 * energy


def test_the_manifest_tells_how_it_came_about(built: BuiltModel, files: Path, subjects, model):
    told = json.loads(files.with_name("next.manifest.json").read_text())
    assert told == built.manifest
    assert [s["subject"] for s in told["subjects"]] == [s.name for s in subjects] and told["rejected"] == []
    assert {s["expressions"] for s in told["subjects"]} == {4} and told["subjects"][0]["weight_of_each"] == 0.25
    assert told["inputs"]["previous"] == gnm_npz.content_hash(model) and len(told["inputs"]) == 8 * 5 + 1
    assert told["identity"]["share_previous"] == 0.2 and 0.99 <= told["identity"]["share_kept"] <= 1
    assert told["identity"]["samples"] == 16 and told["identity"]["weight_of_each"] == 0.5
    assert told["identity"]["shares_tried_mm"] == {} and told["config"]["identity"]["mirrored"] is True
    assert told["identity"]["carried"] == ["eye_000", "eye_001", "eye_002"]
    assert told["categories"] == dict.fromkeys(sorted(CATEGORIES.values()), 8)
    assert sum(told["demographics"]["age"].values()) == 8 and told["demographics"]["gender"] == {"female": 4, "male": 4}
    assert told["figures"]["lid_gap_change_mm"]["worst"] < 0.2 and 0 < told["figures"]["drift_mm"] < 10
    assert told["versions"]["numpy"] == np.__version__ and told["config"]["identity"]["shrinkage"] == 0.2


def test_coefficients_and_landmarks_lie_beside_the_file(built: BuiltModel, files: Path):
    with np.load(files.with_name("next.expressions.npz")) as beside:
        names, mean, covariance = beside["names"], beside["mean"], beside["covariance"]
    assert names.tolist() == built.data.expression_names[: len(names)].tolist()
    assert mean.shape == (len(names),) and covariance.shape == (len(names),) * 2
    assert np.linalg.eigvalsh(covariance).min() > -1e-9
    assert sorted(landmarks.schemes_beside(files, len(built.data.template_vertex_positions))) == ["68", "dense", "oral"]


def test_building_twice_gives_the_same(built: BuiltModel, subjects, model):
    again = build_model(iter_again(subjects), model, true_meshes(), categories=CATEGORIES)
    assert again.manifest == built.manifest


class iter_again:
    """Subjects as a loop reads them from disk: anew each time."""

    def __init__(self, subjects: list[TrainingSubject]):
        self._subjects = subjects

    def __iter__(self):
        return iter(list(self._subjects))


def test_a_built_model_is_built_upon(built: BuiltModel, subjects):
    again = build_model(subjects[:5], built.data)
    for names in (again.data.identity_names.tolist(), again.data.expression_names.tolist()):
        assert len(set(names)) == len(names)
    assert again.data.identity_names.tolist()[-3:] == ["eye_000", "eye_001", "eye_002"]
    assert again.data.expression_names.tolist()[-1] == built.data.expression_names.tolist()[-1] == "pupils_000"
    assert again.manifest["inputs"]["previous"] == built.manifest["content_id"]
    # Joints that are told anew round after round stay where they are.
    one, two = built.data, again.data
    told = two.joint_regressor @ one.template_vertex_positions
    assert 1e3 * np.abs(told - one.template_joint_positions).max() < 0.5


def test_the_previous_models_share_is_chosen_and_told(subjects, model):
    neutrals = [replace(subject, expressions=()) for subject in subjects]
    told = build_model(neutrals, model, with_identity(max_components=10)).manifest["identity"]
    tried = {float(share): rms for share, rms in told["shares_tried_mm"].items()}
    assert len(tried) == 20 and told["share_previous"] == min(tried, key=tried.__getitem__)
    assert told["components"] == 10 and 0 < tried[told["share_previous"]] < tried[0.0] < 10


def test_without_expressions_the_previous_basis_stays(subjects, model):
    built = build_model([replace(subject, expressions=()) for subject in subjects], model)
    assert np.array_equal(built.data.expression_basis, model.expression_basis)
    assert built.coefficients is None and "previous" in built.manifest["expression"]


def test_spoiled_meshes_are_left_out_and_named(subjects, model):
    rng = np.random.default_rng(0)
    spoiled = list(subjects)
    noise = rng.normal(0, 2e-3, subjects[2].neutral.vertices.shape)
    spoiled[2] = replace(subjects[2], neutral=known.mesh("neutral", subjects[2].neutral.vertices + noise, model))
    bad = known.mesh("smile", subjects[5].expressions[0].vertices + noise, model)
    spoiled[5] = replace(subjects[5], expressions=(bad, *subjects[5].expressions[1:]))
    built = build_model(spoiled, model)
    names = [one["name"] for one in built.manifest["rejected"]]
    assert names == [subjects[2].name, f"{subjects[5].name}, smile"]
    told = {one["subject"]: one for one in built.manifest["subjects"]}
    assert len(told) == 7 and told[subjects[5].name]["expressions"] == 3
    assert told[subjects[5].name]["weight_of_each"] == pytest.approx(1 / 3)


def test_skin_that_no_camera_saw_follows_the_previous_model(subjects, model):
    behind = model.template_vertex_positions[:, 2] < -0.02
    broken = []
    for subject in subjects:
        vertices = subject.neutral.vertices + np.float32(0.05) * behind[:, None]
        broken.append(replace(subject, neutral=known.mesh("neutral", vertices, model, ~behind), expressions=()))
    built = build_model(broken, model)
    clean = build_model([replace(subject, expressions=()) for subject in subjects], model)
    away = np.linalg.norm(built.data.template_vertex_positions - clean.data.template_vertex_positions, axis=1)
    skin = regions.exterior(model)
    print(f"unseen {1e3 * away[skin & behind].mean():.2f} mm, seen {1e3 * away[skin & ~behind].mean():.2f} mm off")
    assert away[skin & behind].mean() < 6e-3 and away[skin & ~behind].mean() < 1e-3
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
    act = subject.expressions[1]
    act = replace(act, vertices=act.vertices[:-1], confidence=act.confidence[:-1])
    return replace(subject, expressions=(subject.expressions[0], act))


def _unsure(subject: TrainingSubject) -> TrainingSubject:
    return replace(subject, neutral=replace(subject.neutral, confidence=2 * subject.neutral.confidence))


def _unknown(subject: TrainingSubject) -> TrainingSubject:
    return replace(subject, expressions=(replace(subject.expressions[0], label="sneeze"),))


@pytest.mark.parametrize(
    "spoil, what, got",
    [
        (lambda s: replace(s, neutral=None), "no neutral", "4 expressions"),
        (_nan, "not finite", "1 NaN"),
        (_foreign, "another topology", "another order"),
        (_fewer, "another topology", "21912 vertices"),
        (_unsure, "out of range", "2.0"),
        (_unknown, "label is unknown", "sneeze"),
    ],
)
def test_bad_subjects_are_refused_by_name(subjects, model, spoil, what, got):
    with pytest.raises(InputError) as caught:
        build_model([*subjects[:3], spoil(subjects[3])], model, categories=CATEGORIES)
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


def test_a_registration_without_its_pose(model):
    function, rng = GNM(model), np.random.default_rng(0)
    pose = function.neutral()
    parameters = replace(
        pose,
        identity=torch.as_tensor(rng.normal(size=len(pose.identity)).astype(np.float32)),
        rotations=torch.as_tensor(rng.normal(0, 0.2, pose.rotations.shape).astype(np.float32)),
        translation=torch.tensor([0.1, -1.0, 0.3]),
        scale=torch.tensor(1.1),
    )
    offsets = torch.as_tensor(rng.normal(0, 1e-3, model.template_vertex_positions.shape).astype(np.float32))
    still = replace(parameters, rotations=pose.rotations, translation=pose.translation)
    registration = _registration(parameters, offsets, function)
    found = unpose(registration, function)
    np.testing.assert_allclose(found, function(still, offsets).numpy(), atol=1e-7)
    # Posing it again gives the registration.
    joints = parameters.scale * function.joints(parameters.identity)
    again = function.pose(torch.as_tensor(found), joints, axis_angle_to_matrix(parameters.rotations))
    np.testing.assert_allclose(again + parameters.translation, registration.vertices, atol=2e-6)


def _registration(parameters: Parameters, offsets: torch.Tensor, function: GNM) -> Registration:
    vertices = function(parameters, offsets).numpy()
    arrays = {name: getattr(parameters, name).numpy() for name in ("identity", "expression", "rotations")}
    return Registration(
        status="converged",
        reason="",
        **arrays,
        translation=parameters.translation.numpy(),
        scale=parameters.scale.numpy(),
        offsets=offsets.numpy(),
        vertices=vertices,
        triangles=function.triangles.numpy().astype(np.int32),
        confidence=np.ones(len(vertices), np.float32),
        texture=np.zeros((2, 2, 3), np.float32),
        corner_uvs=np.zeros((len(function.triangles), 3, 2), np.float32),
    )


@needs_shared
def test_the_official_schema_of_another_model_is_kept(tmp_path: Path):
    """Float16 bases and all: neutrals drawn from the file itself."""
    model = gnm_npz.read(SHARED / "data" / "gnm" / "gnm_head_reconstructed.npz")
    rng = np.random.default_rng(0)
    heads = known.heads(model, rng.normal(size=(6, len(known.head_components(model)))))
    subjects = [
        TrainingSubject(name=str(k), neutral=known.mesh("neutral", head, model)) for k, head in enumerate(heads)
    ]
    built = build_model(subjects, model)
    gnm_npz.write(built.data, tmp_path / "next.npz")
    again = gnm_npz.read(tmp_path / "next.npz")
    assert gnm_npz.content_hash(again) == built.manifest["content_id"]
    assert again.vertex_identity_basis.dtype == model.vertex_identity_basis.dtype == np.float16
    assert built.manifest["figures"]["lid_gap_change_mm"]["worst"] < 0.2
