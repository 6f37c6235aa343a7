"""A file of FLAME's shape: its pickle and NPZ are the model that they were written from, and refuse what is wrong."""

import os
import pickle
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from bench.support.flame_shaped import FlameShape, flame_shaped, write_flame_npz, write_flame_pickle
from registration.errors import InputError
from registration.geometry.topology import boundary_vertices, directed_edges_used_twice
from registration.linear_models import flame
from registration.linear_models.model import LinearModel
from registration.linear_models.options import ReadOptions
from registration.linear_models.registry import detect_format, read
from registration.model.landmarks import read_scheme, schemes_beside
from tests.conftest import FIXTURES
from tests.fixtures.make_fixtures import tiny_model

SIZE = FlameShape(identity=7, expression=4)
OPTIONS = ReadOptions(identity_components=7)


@pytest.fixture(scope="module")
def made():
    data = tiny_model()
    scheme = read_scheme(FIXTURES / "head_sparse_68.txt", data.template_vertex_positions)
    return flame_shaped(data, scheme, SIZE)


@pytest.fixture(scope="module")
def file(made, tmp_path_factory) -> Path:
    return write_flame_pickle(made[0], tmp_path_factory.mktemp("flame") / "generic_model.pkl", made[1])


def rodrigues(axis_angle: np.ndarray) -> np.ndarray:
    from scipy.spatial.transform import Rotation

    return Rotation.from_rotvec(axis_angle).as_matrix()


def published_function(arrays: dict[str, np.ndarray], betas: np.ndarray, poses: np.ndarray) -> np.ndarray:
    """Skinning as SMPL and FLAME define it, written out with 4 x 4 transforms."""
    shaped = arrays["v_template"] + arrays["shapedirs"] @ betas
    joints = arrays["J_regressor"] @ shaped
    rotations = [rodrigues(pose) for pose in poses]
    feature = np.concatenate([(R - np.eye(3)).ravel() for R in rotations[1:]])
    posed = shaped + arrays["posedirs"] @ feature
    world: list[np.ndarray] = []
    for j, R in enumerate(rotations):
        local = np.eye(4)
        local[:3, :3] = R
        parent = int(arrays["kintree_table"][0, j])
        local[:3, 3] = joints[j] if j == 0 else joints[j] - joints[parent]
        world.append(local if j == 0 else world[parent] @ local)
    relative = []
    for j, transform in enumerate(world):
        back = np.eye(4)
        back[:3, 3] = -joints[j]
        relative.append(transform @ back)
    blended = np.einsum("vj,jab->vab", arrays["weights"], np.stack(relative))
    return np.einsum("vab,vb->va", blended, np.concatenate([posed, np.ones((len(posed), 1))], 1))[:, :3]


def test_the_fixture_has_the_shape_of_flame(made):
    arrays, landmarks = made
    assert arrays["v_template"].shape == (5023, 3) and arrays["weights"].shape == (5023, 5)
    assert directed_edges_used_twice(arrays["f"].astype(int)) == 0
    assert len(np.unique(arrays["f"])) == 5023 and boundary_vertices(arrays["f"].astype(int), 5023).sum() > 0
    assert np.allclose(arrays["J_regressor"] @ arrays["v_template"], arrays["J"], atol=1e-9)
    points = landmarks.points(arrays["v_template"])
    jaw = landmarks.points(arrays["weights"])[:, 2]
    assert jaw[8] > 0.5 and jaw[27:48].max() < 0.01  # the chin, not nose or eyes
    assert points[36:48, 1].min() > points[48:68, 1].max()  # the eyes are above the mouth


def test_a_pickle_is_read_as_the_published_function(made, file):
    assert detect_format(file).name == "flame"
    model = read(file, OPTIONS)
    assert model.joints.names == flame.JOINTS[5] and model.remarks == () and "Max Planck" in model.licence
    rng = np.random.default_rng(0)
    betas, poses = rng.normal(size=11), 0.4 * rng.normal(size=(5, 3))
    torch_model = LinearModel(model, torch.float64)
    parameters = replace(
        torch_model.neutral(),
        identity=torch.from_numpy(betas[:7]),
        expression=torch.from_numpy(betas[7:]),
        rotations=torch.from_numpy(poses),
    )
    expected = published_function(made[0], betas, poses)
    assert np.abs(torch_model(parameters).numpy() - expected).max() < 1e-6
    assert schemes_beside(file, model.template)["68"].points(model.template).shape == (68, 3)


def test_an_npz_is_the_same_model(made, file, tmp_path):
    other = read(write_flame_npz(made[0], tmp_path / "flame.npz"), OPTIONS)
    model = read(file, OPTIONS)
    for name in ("template", "identity_basis", "expression_basis", "triangles"):
        assert np.array_equal(getattr(model, name), getattr(other, name))
    assert np.array_equal(model.joints.correctives, other.joints.correctives)


def test_without_the_jaw_the_neck_moves_what_it_moved(file):
    model = read(file, replace(OPTIONS, without_jaw=True))
    assert model.joints.names == flame.JOINTS[4] and model.joints.parents.tolist() == [-1, 0, 1, 1]
    assert model.joints.correctives.shape == (36, 3 * 5023)


def test_the_unit_is_told_and_stated(made, tmp_path):
    large = {**made[0], "v_template": made[0]["v_template"] * 1e3, "shapedirs": made[0]["shapedirs"] * 1e3}
    model = read(write_flame_npz(large, tmp_path / "flame.npz"), OPTIONS)
    assert model.unit_m == 1e-3 and "the unit is taken as mm" in model.remarks[0]
    assert np.allclose(model.template, made[0]["v_template"], atol=1e-6)


def test_other_numbers_of_components_have_to_be_stated(file):
    with pytest.raises(InputError, match="cannot be told from its expressions"):
        read(file)
    with pytest.raises(InputError, match="11 components, 12 of them identities"):
        read(file, ReadOptions(identity_components=12))


def test_a_pickle_that_wants_to_run_something_is_refused(made, tmp_path):
    class Runs:
        def __reduce__(self):
            return os.system, (f"touch {tmp_path / 'was_run'}",)

    file = tmp_path / "flame.pkl"
    file.write_bytes(pickle.dumps({**made[0], "J_regressor": Runs()}, 2))
    with pytest.raises(InputError, match="wants to run posix.system"):
        read(file, OPTIONS)
    assert not (tmp_path / "was_run").exists()


@pytest.mark.parametrize(
    ("arrays", "message"),
    [
        ({"weights": None}, "weights"),
        ({"v_template": np.zeros((5, 3))}, "wrong shape"),
        ({"f": np.full((2, 3), 5023)}, "indices from 0 to 5022"),
        ({"f": np.zeros((2, 3))}, "integer"),
        ({"posedirs": np.zeros((5023, 3, 27))}, "36 pose correctives"),
        ({"kintree_table": np.array([[-1, 0, 1, 1, 1], [0, 1, 2, 4, 3]])}, "out of order"),
        ({"kintree_table": np.array([[-1, 2, 1, 1, 1], [0, 1, 2, 3, 4]])}, "every parent before"),
        ({"weights": np.ones((5023, 5))}, "sum to 1"),
        ({"shapedirs": np.full((5023, 3, 11), np.inf)}, "finite numbers"),
    ],
    ids=lambda value: next(iter(value)) if isinstance(value, dict) else None,
)
@pytest.mark.parametrize("form", ["pickle", "npz"])
def test_wrong_arrays_are_refused(made, tmp_path, arrays, message, form):
    changed = {name: array for name, array in {**made[0], **arrays}.items() if array is not None}
    file = tmp_path / "flame"
    if form == "pickle":
        file.write_bytes(pickle.dumps(changed, 2))
    else:
        with file.open("wb") as stream:
            np.savez(stream, **changed)
    with pytest.raises(InputError, match=re.escape(message)):
        read(file, OPTIONS)
