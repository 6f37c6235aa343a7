"""The plain form: round trips, units and axes, optional arrays, and what is refused."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from registration.errors import InputError
from registration.linear_models import plain_npz
from registration.linear_models.frame import turn
from registration.linear_models.gnm import from_gnm
from registration.linear_models.model import LinearModel
from registration.linear_models.options import ReadOptions
from registration.linear_models.registry import detect_format, read
from tests.conftest import FIXTURES
from tests.fixtures.make_fixtures import tiny_model
from tests.registration.model.test_gnm import random_parameters, with_correctives

ZERO = {"scale": torch.tensor(1.0).double(), "translation": torch.zeros(3).double()}


@pytest.fixture(scope="module")
def model():
    return from_gnm(with_correctives(tiny_model()), licence="licence of the file: CC0")


@pytest.fixture
def file(model, tmp_path) -> Path:
    plain_npz.write(model, tmp_path / "plain.npz")
    return tmp_path / "plain.npz"


def changed(file: Path, **arrays: object) -> Path:
    with np.load(file) as archive:
        content = {name: archive[name] for name in archive.files} | arrays
    np.savez(file, **{name: np.asarray(array) for name, array in content.items() if array is not None})
    return file


def test_the_plain_form_keeps_the_model(model, file):
    back = read(file)
    assert (back.format, back.name, back.licence, back.remarks) == ("plain", model.name, "licence of the file: CC0", ())
    assert back.joints.names == model.joints.names
    p = random_parameters(LinearModel(model, torch.float64))
    assert torch.equal(LinearModel(back, torch.float64)(p), LinearModel(model, torch.float64)(p))


def test_a_gnm_file_is_told_by_its_content(tmp_path):
    file = tmp_path / "named_like_nothing"
    file.write_bytes((FIXTURES / "tiny_gnm.npz").read_bytes())
    assert detect_format(file).name == "gnm" and read(file).joints.names[0] == "neck"
    with pytest.raises(InputError, match="no jaw joint"):
        read(file, ReadOptions(without_jaw=True))


def test_other_units_and_axes_are_turned_into_ours(model, file):
    """Of a file in millimetres, +Z up and -Y to the front, the posed model is the same."""
    to_file = 1e3 * np.linalg.inv(turn("+z", "-y"))

    def moved(array):
        return (array.astype(np.float64) @ to_file.T).astype(np.float32)

    T = np.linalg.inv(turn("+z", "-y"))
    C = model.joints.correctives.astype(np.float64).reshape(-1, 9, 3 * len(model.template))
    C = np.einsum("ab,jbc->jac", np.kron(T, T), C).reshape(9 * len(model.joints.names), -1, 3)
    changed(
        file,
        template=moved(model.template),
        identity_basis=moved(model.identity_basis),
        expression_basis=moved(model.expression_basis),
        joint_template=moved(model.joints.template),
        joint_identity_basis=moved(model.joints.identity_basis),
        pose_correctives=moved(C).reshape(len(C), -1),
        unit_m=None,
        up="+Z",
        front="-Y",
    )
    back = read(file)
    assert back.unit_m == 1e-3 and any("unit is taken as mm" in remark for remark in back.remarks)
    expected = LinearModel(model, torch.float64)
    p = replace(random_parameters(expected), **ZERO)
    assert torch.allclose(LinearModel(back, torch.float64)(p), expected(p), atol=2e-7)
    wrong = read(file, ReadOptions(up="-x", front="-y"))
    assert any("symmetric across its Y axis" in remark for remark in wrong.remarks), wrong.remarks


def test_deviations_scale_the_bases_and_a_model_may_have_no_joints(model, file):
    joints = {name: None for name in (*plain_npz.JOINTS, *plain_npz.OPTIONAL_OF_JOINTS)}
    deviations = np.arange(1.0, 7.0)
    back = read(changed(file, **joints, identity_deviations=deviations, something=np.zeros(2)))
    assert np.allclose(back.identity_basis, model.identity_basis * deviations[:, None, None], rtol=1e-5)
    assert back.joints.names == ("head",) and back.remarks == ("arrays that are not used: something",)
    evaluated = LinearModel(back, torch.float64)
    p = replace(random_parameters(evaluated), **ZERO)
    p = replace(p, rotations=torch.tensor([[0.0, torch.pi, 0.0]]).double())
    still = replace(p, rotations=torch.zeros(1, 3).double())
    assert torch.allclose(evaluated(p)[:, 1], evaluated(still)[:, 1], atol=1e-9)


@pytest.mark.parametrize(
    ("arrays", "message"),
    [
        ({"template": None}, "a file of another kind"),
        ({"identity_basis": None}, "'identity_basis' is missing"),
        ({"triangles": np.full((2, 3), 10**6)}, "indices from 0"),
        ({"expression_basis": np.zeros((2, 5, 3))}, "wrong shape"),
        ({"skinning_weights": None}, "'skinning_weights' is missing"),
        ({"joint_parents": [-1, 2, 1, 0]}, "every parent before its children"),
        ({"skinning_weights": np.ones((1163, 4))}, "sum to 1"),
        ({"unit_m": -1.0}, "metres per unit of the file"),
        ({"unit_m": None, "template": np.full((1163, 3), 7.0)}, "unit of the linear model cannot be told"),
        ({"up": "+z", "front": "-z"}, "two different axes"),
        ({"up": "north"}, "the up axis north"),
        ({"template": np.full((1163, 3), np.nan)}, "finite numbers"),
    ],
    ids=lambda value: "-".join(value) if isinstance(value, dict) else None,
)
def test_wrong_arrays_are_refused(file, arrays, message):
    with pytest.raises(InputError, match=re.escape(message)):
        read(changed(file, **arrays))
    with pytest.raises(InputError, match="no jaw joint"):
        plain_npz.write(from_gnm(tiny_model()), file)
        read(file, ReadOptions(without_jaw=True))


def test_other_files_are_named(tmp_path):
    file = tmp_path / "model.npz"
    for content, message in ((b"hello", "a file of another kind"), (b"", "an empty file"), (b"glTF", "glTF")):
        file.write_bytes(content)
        with pytest.raises(InputError, match=message):
            read(file)
    with pytest.raises(InputError, match="no such file"):
        read(tmp_path / "nothing")
    with pytest.raises(InputError, match="a folder without"):
        read(tmp_path)
