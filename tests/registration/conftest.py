"""The model that the project builds from nothing, and the released one where it is at hand."""

import pytest

from coregister.first_model.build import bootstrap
from registration.errors import InputError
from registration.model import gnm_npz
from registration.model.gnm_npz import GNMData
from tests.conftest import SHARED

GNM = SHARED / "data" / "gnm" / "gnm_head_reconstructed.npz"


@pytest.fixture(scope="session")
def first_model() -> GNMData:
    try:
        return gnm_npz.read(bootstrap())
    except InputError as error:
        pytest.skip(f"{error.what}: {error.got}")


@pytest.fixture(scope="session")
def gnm_model() -> GNMData:
    if not GNM.is_file():
        pytest.skip("no folder 'shared' beside the repository")
    return gnm_npz.read(GNM)


@pytest.fixture(scope="session", params=["first_model", "gnm_model"])
def any_model(request: pytest.FixtureRequest) -> GNMData:
    data: GNMData = request.getfixturevalue(request.param)
    return data
