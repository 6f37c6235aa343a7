"""True subjects and what a registration would observe of them, once per session."""

import pytest

from bench.support import performances
from bench.support.performances import ObservedSubject, TrueSubject
from registration.model.gnm_npz import GNMData
from registration.stabilize.components import HeadGeometry
from registration.stabilize.subject_meshes import SkullSkin
from tests.coregister.conftest import head_assembly, model, model_file, source, wheel  # noqa: F401  fixtures


@pytest.fixture(scope="session")
def head(model: GNMData) -> HeadGeometry:  # noqa: F811
    return HeadGeometry.from_model(model)


@pytest.fixture(scope="session")
def skin(model: GNMData) -> SkullSkin:  # noqa: F811
    return SkullSkin.from_model(model)


@pytest.fixture(scope="session")
def truths(head_assembly) -> list[TrueSubject]:  # noqa: F811
    return [performances.true_subject(head_assembly, 1000 + number) for number in range(3)]


@pytest.fixture(scope="session")
def observations(truths: list[TrueSubject]) -> list[ObservedSubject]:
    return [performances.observe(truth, number) for number, truth in enumerate(truths)]
