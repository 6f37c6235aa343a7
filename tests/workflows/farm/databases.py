"""Farms on SQLite and on a real PostgreSQL, as fixtures of the tests in `tests/workflows`."""

import re
from collections.abc import Iterator
from pathlib import Path

import pytest
import sqlalchemy as sa

from bench.support.postgres_server import Server, programs, server
from tests.workflows.farm.harness import Farm, open_farm
from workflows.engine.database import checked_url, engine


@pytest.fixture(scope="session")
def postgres() -> Iterator[Server]:
    if programs() is None:
        pytest.skip("no PostgreSQL here; make test-durability installs it")
    with server() as running:
        yield running


@pytest.fixture(params=["sqlite", "postgres"])
def farm(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Farm]:
    url = None
    if request.param == "postgres":
        base = request.getfixturevalue("postgres").url
        name = "q" + re.sub(r"\W", "", request.node.name).lower()[-40:]
        connection = engine(checked_url(base)).connect().execution_options(isolation_level="AUTOCOMMIT")
        connection.execute(sa.text(f"CREATE DATABASE {name}"))
        connection.close()
        url = base.rpartition("/")[0] + f"/{name}"
    with open_farm(tmp_path, url) as opened:
        yield opened
