"""The real detector; skipped where its nets are neither cached nor to be had."""

import pytest

from registration.detect.face478 import Face478Provider
from registration.detect.weights import read_face_landmarker
from registration.errors import InputError


@pytest.fixture(scope="session")
def provider() -> Face478Provider:
    try:
        read_face_landmarker()
    except InputError as error:
        pytest.skip(f"{error.what}: {error.got}")
    return Face478Provider()
