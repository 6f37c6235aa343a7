"""Both models whose anatomy is found."""

import pytest

from registration.model import gnm_npz
from registration.model.gnm_npz import GNMData
from tests.conftest import SHARED

GNM = SHARED / "data" / "gnm" / "gnm_head_reconstructed.npz"


@pytest.fixture(scope="session")
def first_model(model: GNMData) -> GNMData:
    return model


@pytest.fixture(scope="session")
def gnm_model() -> GNMData:
    if not GNM.is_file():
        pytest.skip("no folder 'shared' beside the repository")
    return gnm_npz.read(GNM)


@pytest.fixture(params=["first_model", "gnm_model"])
def any_model(request: pytest.FixtureRequest) -> GNMData:
    data: GNMData = request.getfixturevalue(request.param)
    return data
