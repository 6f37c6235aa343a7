"""Basel, LSFM and ICT files in their own units: readers give back the face that was written, or refuse the file."""

from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest

from registration.errors import InputError
from registration.linear_models import basel, ict
from registration.linear_models.model import LinearModel
from registration.linear_models.registry import detect_format, read
from tests.fixtures import linear_models as fixtures
from tests.registration.model.test_gnm import random_parameters


@pytest.fixture(scope="module")
def face() -> fixtures.Principal:
    return fixtures.principal_face()


def assert_same(file: Path, face: fixtures.Principal, *, name: str, remarks: str, expressions: bool = False):
    assert detect_format(file).name == name
    model = read(file)
    mean = face.mean + face.expression_mean if expressions and name == "basel" else face.mean
    assert np.abs(model.template - mean).max() < 1e-6
    scaled = face.identity * face.identity_deviations[:, None]
    assert np.abs(model.identity_basis.reshape(scaled.shape) - scaled).max() < 1e-6
    assert np.array_equal(model.triangles, face.triangles)
    assert len(model.expression_basis) == (3 if expressions else 0) and "; ".join(model.remarks) == remarks
    assert model.joints.names == ("head",)
    evaluated = LinearModel(model)
    assert evaluated(random_parameters(evaluated, 2)).shape == (2, *mean.shape)
    return model


def test_basel_2017_is_read_in_millimetres(face, tmp_path):
    file = fixtures.write_basel(face, tmp_path / "model.h5")
    model = assert_same(file, face, name="basel", remarks="", expressions=True)
    scaled = face.expression * face.expression_deviations[:, None]
    assert model.unit_m == 1e-3 and np.abs(model.expression_basis.reshape(scaled.shape) - scaled).max() < 1e-6
    assert "University of Basel" in model.licence


def test_components_may_have_the_length_of_their_deviations(face, tmp_path):
    file = fixtures.write_basel(face, tmp_path / "model.h5")
    with h5py.File(file, "r+") as opened:
        basis, variance = opened["shape/model/pcaBasis"], opened["shape/model/pcaVariance"]
        basis[...] = basis[...] * np.sqrt(variance[...])
    remark = "shape: the components have the length of their deviations already"
    assert_same(file, face, name="basel", remarks=remark, expressions=True)


LSFM_REMARKS = "the file has no expressions; the unit is taken as mm: the template is 290 mm long"


@pytest.mark.parametrize("form", ["compressed", "plain", "7.3"])
def test_lsfm_is_read_from_both_versions(face, tmp_path, form):
    arrays, file = fixtures.lsfm_arrays(face), tmp_path / "all.mat"
    if form == "7.3":
        fixtures.write_mat_7_3(arrays, file)
    else:
        fixtures.write_mat(arrays, file, compressed=form == "compressed")
    assert assert_same(file, face, name="mat", remarks=LSFM_REMARKS).name == "LSFM"


def test_basel_2009_is_read_in_micrometres_and_turned_outwards(face, tmp_path):
    file = fixtures.write_mat(fixtures.basel_2009_arrays(face), tmp_path / "01_MorphableModel.mat")
    remarks = (
        "the file has no expressions; the unit is taken as um: the template is 290 mm long; "
        "the triangles are turned round: they faced inwards"
    )
    model = assert_same(file, face, name="mat", remarks=remarks)
    assert model.name == "Basel Face Model 2009" and model.unit_m == 1e-6


def test_ict_is_read_in_centimetres(face, tmp_path):
    folder = fixtures.write_ict(face, tmp_path / "FaceXModel")
    remark = "expressions are blendshapes of weights from 0 to 1, not standard deviations"
    model = assert_same(folder, face, name="ict", remarks=remark, expressions=True)
    shapes = 0.05 * face.expression[[1, 0, 2]]  # by name
    assert np.abs(model.expression_basis.reshape(shapes.shape) - shapes).max() < 1e-6


def test_damaged_ict_folders_are_refused(face, tmp_path):
    folder = fixtures.write_ict(face, tmp_path / "FaceXModel")
    (folder / "identity001.obj").rename(folder / "identity009.obj")
    with pytest.raises(InputError, match="identity001.obj"):
        read(folder)
    (folder / "identity009.obj").rename(folder / "identity001.obj")
    (folder / "jawOpen.obj").write_text("v 0 0 0\nf 1 1 1\n")
    with pytest.raises(InputError, match="vertices"):
        read(folder)
    (folder / "jawOpen.obj").write_text("v 0 0 x\n")
    with pytest.raises(InputError, match="an OBJ mesh"):
        read(folder)
    (folder / ict.NEUTRAL).unlink()
    with pytest.raises(InputError, match="a folder without a model's files"):
        read(folder)


@pytest.mark.parametrize(
    ("path", "value", "message"),
    [
        ("shape/model/mean", None, "a link, or nothing"),
        ("shape/model/mean", np.zeros(7, np.float32), "three coordinates"),
        ("shape/model/mean", np.array([1, 2, 3]), "array of floats"),
        ("shape/model/pcaBasis", np.zeros((4, 4), np.float32), "either way round"),
        ("shape/model/pcaBasis", None, "none of|another kind|HDF5"),
        ("shape/model/pcaVariance", np.full(5, -1, np.float32), "finite numbers from 0"),
        ("shape/model/pcaVariance", np.full(5, np.nan, np.float32), "finite numbers"),
        ("shape/representer/cells", np.full((3, 4), 10**6, np.int32), "indices of"),
        ("shape/representer/cells", np.zeros((2, 4), np.int32), "three corners"),
        ("expression/model/pcaBasis", h5py.SoftLink("/shape/model/pcaBasis"), "a link"),
        ("expression/model/pcaVariance", h5py.ExternalLink("/etc/passwd", "/"), "a link"),
    ],
)
def test_damaged_basel_files_are_refused(face, tmp_path, path, value, message):
    file = fixtures.write_basel(face, tmp_path / "model.h5")
    with h5py.File(file, "r+") as opened:
        del opened[path]
        if value is not None:
            opened[path] = value
    with pytest.raises(InputError, match=message):
        read(file)


@pytest.mark.parametrize(
    ("arrays", "message"),
    [
        ({"mean": None}, "no mean"),
        ({"components": None}, "no components"),
        ({"eigenvalues": None}, "one of eigenvalues"),
        ({"eigenvalues": -np.ones(5)}, "variances from 0"),
        ({"eigenvalues": np.ones(4)}, "either way round"),
        ({"trilist": np.full((2, 3), 0.5)}, "whole numbers"),
        ({"trilist": np.full((2, 3), 1e6)}, "indices of"),
        ({"mean": np.full((30, 1), np.nan)}, "either way round|finite"),
        ({"components": np.ones((2, 2)) * 1j}, "no components"),
    ],
    ids=lambda value: next(iter(value)) if isinstance(value, dict) else None,
)
def test_damaged_mat_files_are_refused(face, tmp_path, arrays, message):
    changed = {k: v for k, v in {**fixtures.lsfm_arrays(face), **arrays}.items() if v is not None}
    with pytest.raises(InputError, match=message):
        read(fixtures.write_mat(changed, tmp_path / "all.mat"))


def test_a_basel_file_without_expressions_says_so(face, tmp_path):
    file = fixtures.write_basel(replace(face), tmp_path / "model.h5")
    with h5py.File(file, "r+") as opened:
        del opened["expression"]
    assert read(file).remarks == ("the file has no expressions",)
    assert detect_format(file).read is basel.read
