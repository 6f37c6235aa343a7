"""A coregistration in the queue: refused while its jobs run, replaced after they have ended."""

from pathlib import Path

import pytest

from registration.errors import InputError
from registration.progress import NullProgress
from tests.workflows.rounds import MODEL, write_people
from workflows.engine.client import QueueClient
from workflows.engine.database import default_url
from workflows.engine.jobs import FlowJob, Job
from workflows.engine.process import migrate
from workflows.engine.reader import QueueReader
from workflows.farm.coregistration import coregister, submit_coregistration
from workflows.farm.local import LocalFarm, run_until_done
from workflows.farm.plan import RoundSettings, make_plan
from workflows.records.round_files import PLAN


def test_an_active_run_is_kept_and_an_ended_run_is_replaced(capture: Path, tmp_path: Path) -> None:
    dataset = write_people(capture, tmp_path / "dataset", 5)
    url, out = default_url(tmp_path), tmp_path / "june"
    plan = make_plan(dataset, MODEL, out, rounds=RoundSettings(components=(2,)))
    with pytest.raises(InputError, match="There is no queue"):
        submit_coregistration(url, plan)
    assert not out.exists()
    migrate(url)
    assert submit_coregistration(url, plan) == "june"
    queue, reader = QueueClient(url), QueueReader(url)
    row = reader.rows(["june"])["june"]
    assert row.state == "waiting"
    assert row.spec == {"flow": "coregister", "arguments": {"plan": str(out / PLAN)}}
    queue.submit([Job(id="june/it00/s00000/neutral", step="register")])
    with pytest.raises(InputError, match="have not ended"):
        submit_coregistration(url, plan)
    queue.cancel("june")
    submit_coregistration(url, plan)
    assert reader.rows(["june"])["june"].state == "waiting" and not reader.counts("june", kind="job")


def test_the_name_of_a_batch_is_refused(capture: Path, tmp_path: Path) -> None:
    plan = make_plan(
        write_people(capture, tmp_path / "dataset", 5), MODEL, tmp_path / "june", rounds=RoundSettings(components=(2,))
    )
    url = default_url(tmp_path)
    migrate(url)
    QueueClient(url).submit([FlowJob(id="june", flow="batch", queue="driver")])
    with pytest.raises(InputError, match="The run is a batch"):
        submit_coregistration(url, plan)
    with pytest.raises(InputError, match="The run is a batch"):
        coregister(plan, url=url, folder=tmp_path / "farm")
    assert QueueReader(url).rows(["june"])["june"].state == "waiting" and not plan.out.exists()


def test_without_a_worker_nothing_starts(tmp_path: Path) -> None:
    farm = LocalFarm(url=default_url(tmp_path), folder=tmp_path, roots=(), workers=0)
    with pytest.raises(InputError, match="no worker"):
        run_until_done(farm, "june", NullProgress())
