"""A review's page starts as a child process, and answers with its token only."""

import urllib.error
import urllib.request

import pytest

from tests.coregister.conftest import head_assembly, model, model_file, source, wheel  # noqa: F401  fixtures
from tests.workflows.web.test_review import run  # noqa: F401  fixture
from workflows.service.reviews import Reviews


@pytest.mark.slow
def test_a_review_answers_with_its_token_until_the_service_stops(run, model_file):  # noqa: F811
    reviews = Reviews()
    try:
        address = reviews.open(run, model_file)
        assert urllib.request.urlopen(address, timeout=30).status == 200
        with pytest.raises(urllib.error.HTTPError, match="403"):
            urllib.request.urlopen(address.partition("?")[0], timeout=30)
    finally:
        reviews.stop()
    with pytest.raises(urllib.error.URLError, match="refused"):
        urllib.request.urlopen(address, timeout=30)
