"""Lists of runs, jobs and subjects, filtered and in parts, from a queue with real rows; priorities; logs by offset."""

import pytest
import sqlalchemy as sa

from tests.workflows.service.conftest import open_service
from workflows.engine.client import QueueClient
from workflows.engine.database import engine
from workflows.engine.jobs import DRIVER, FlowJob, Job


@pytest.fixture(scope="module")
def farm(tmp_path_factory):
    """Two runs: a batch of three captures of two subjects, and a round with one subject."""
    with open_service(tmp_path_factory.mktemp("lists")) as service:
        client = QueueClient(service.state.settings.url)
        ids = ("week/ann/neutral", "week/ann/smile", "week/bob/neutral", "rounds/it00/s00003-ann/e001-smile")
        client.submit(Job(id=i, step="register stored", arguments={"capture": f"/data/{i}"}) for i in ids)
        client.submit([FlowJob(id="week", flow="batch", queue=DRIVER)])
        client.close()
        service.state.board.refresh()
        yield service


def names(page):
    return [job["id"] for job in page["jobs"]]


def test_jobs_are_filtered_and_listed_in_parts(farm):
    assert farm.get("/jobs").json["total"] == 4
    first, second = (farm.get(f"/jobs?run=week&limit=2&offset={offset}").json for offset in (0, 2))
    assert names(first) + names(second) == ["week/ann/neutral", "week/ann/smile", "week/bob/neutral"]
    assert names(farm.get("/jobs?subject=ann").json) == [
        "rounds/it00/s00003-ann/e001-smile",
        "week/ann/neutral",
        "week/ann/smile",
    ]
    assert names(farm.get("/jobs?text=SMILE&run=week").json) == ["week/ann/smile"]
    assert farm.get("/jobs?state=done").json["total"] == 0
    assert farm.get("/jobs?run=none").problem["status"] == 404


def test_runs_have_their_kind_and_counts(farm):
    runs = {run["id"]: run for run in farm.get("/runs").json}
    assert runs["week"]["kind"] == "batch" and runs["week"]["counts"] == {"waiting": 3}
    assert [run["id"] for run in farm.get("/runs?kind=batch").json] == ["week"]
    assert farm.get("/runs?offset=2").json == []
    assert farm.get("/runs/none").problem["status"] == 404


def test_subjects_are_groups_of_captures(farm):
    page = farm.get("/subjects").json
    assert [(s["name"], s["id"], s["counts"]) for s in page["subjects"]] == [
        ("ann", "rounds/it00/s00003-ann", {"waiting": 1}),
        ("ann", "week/ann", {"waiting": 2}),
        ("bob", "week/bob", {"waiting": 1}),
    ]
    assert farm.get("/subjects?name=bob").json["total"] == 1


def test_a_priority_is_that_of_waiting_jobs_of_the_part(farm):
    assert farm.post("/priority", {"run": "week/ann", "priority": 2}).json == {"count": 2}
    with engine(farm.state.settings.url).connect() as connection:
        rows = dict(connection.execute(sa.text("SELECT workflow_uuid, priority FROM workflow_status")).all())
    assert rows["week/ann/smile"] == 2 and rows["week/bob/neutral"] == 10
    assert farm.post("/priority", {"run": "week", "priority": 0}).problem["status"] == 422


def test_a_log_is_read_from_an_offset_without_passwords(farm):
    folder = farm.folder / "logs" / "week" / "ann"
    folder.mkdir(parents=True)
    (folder / "smile.log").write_text("one\npostgresql://me:canary@host/db\n")
    whole = farm.get("/logs/week/ann/smile").json
    assert whole["text"].startswith("one\n") and "canary" not in whole["text"]
    rest = farm.get("/logs/week/ann/smile?offset=4").json
    assert rest["next_offset"] == whole["next_offset"] and rest["text"].startswith("postgresql")
    assert farm.get(f"/logs/week/ann/smile?offset={whole['next_offset']}").json["text"] == ""
    for name in ("week/ann/none", "../../etc/passwd", "%2e%2e/x"):
        assert farm.get(f"/logs/{name}").problem["status"] == 404


def test_a_run_is_cancelled_and_requeued(farm):
    assert farm.post("/cancel", {"run": "rounds"}).json == {"count": 1}
    assert farm.get("/jobs?run=rounds").json["jobs"][0]["state"] == "cancelled"
    for _ in range(2):  # a repeated request gets the first answer
        again = farm.post("/retry", {"run": "rounds", "cancelled": True}, Idempotency_Key="once")
        assert again.json == {"count": 1}
    assert farm.get("/jobs?run=rounds").json["jobs"][0]["state"] == "waiting"
