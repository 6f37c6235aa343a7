"""Rows that somebody else wrote into the queue's database: none runs code, and each ends with a reason."""

import base64
import contextlib
import json
import os
import pickle
from pathlib import Path
from typing import Any

import pytest
import sqlalchemy as sa
from dbos import DBOSClient

from tests.workflows.farm.harness import Farm, open_farm
from tests.workflows.farm.test_hostile import Trap
from workflows.cli.app import main
from workflows.engine.database import checked_url, engine, table
from workflows.engine.jobs import VERSION, Job
from workflows.engine.serialization import APPLICATION, JsonSerializer, UnreadableRow

OURS = JsonSerializer().name()
TALK = {"step": "talk", "arguments": {"text": "x"}}


class Forger:
    """Writes rows as somebody with the database's password can; its pickles create a file when they are read."""

    def __init__(self, farm: Farm) -> None:
        self._farm = farm
        self._engine = engine(checked_url(farm.url))
        self.sprung = farm.folder / "sprung"
        self.trap = base64.b64encode(pickle.dumps(Trap(self.sprung))).decode()

    def insert(self, relation: str, /, **values: Any) -> None:
        columns = ", ".join(f'"{column}"' for column in values)
        query = f"INSERT INTO {table(self._farm.queue.url, relation)} ({columns}) VALUES (:{', :'.join(values)})"
        with self._engine.begin() as connection:
            connection.execute(sa.text(query), values)

    def row(self, identity: str, text: str | None = None, /, **changed: Any) -> str:
        """Insert a row, that of a waiting job if nothing is changed; return its id."""
        values = {
            "workflow_uuid": identity,
            "status": "ENQUEUED",
            "name": "job",
            "queue_name": "gpu",
            "application_version": VERSION,
            "application_name": APPLICATION,
            "serialization": OURS,
            "created_at": 1_700_000_000_000,
            "priority": 5,
        }
        self.insert("workflow_status", **{**values, **changed})
        text = json.dumps({"args": [TALK], "kwargs": {"queue": "gpu"}}) if text is None else text
        self.insert("workflow_input", workflow_uuid=identity, inputs=text, retention_timestamp=1)
        return identity


def test_no_forged_row_runs_and_each_ends_with_its_reason(farm: Farm) -> None:
    forger = Forger(farm)
    portable = json.dumps({"positionalArgs": [TALK], "namedArgs": {"queue": "gpu"}})
    unknown = json.dumps({"args": [{"step": "os:system", "arguments": {}}], "kwargs": {"queue": ""}})
    pickled = {"serialization": "py_pickle"}
    rows = {
        forger.row("run/pickle", forger.trap, **pickled): "its serialization is 'py_pickle'",
        forger.row("run/pickle2", "", inputs=forger.trap, **pickled): "its serialization is 'py_pickle'",
        forger.row("run/none", forger.trap, serialization=None): "its serialization is None",
        forger.row("run/ours", forger.trap): "is not JSON",
        forger.row("run/portable", portable, serialization="portable_json"): "its serialization is 'portable_json'",
        forger.row("run/superjson", serialization="js_superjson"): "its serialization is 'js_superjson'",
        forger.row("run/brace", "{"): "is not JSON",
        forger.row("run/deep", "[" * 200_000): "is not JSON",
        forger.row("run/nan", '{"args": [NaN], "kwargs": {"queue": "gpu"}}'): "NaN",
        forger.row("run/number", "5"): "inputs are 5",
        forger.row("run/error", '{"error": 5}'): "inputs are",
        forger.row("run/args", '{"args": 5, "kwargs": {"queue": "gpu"}}'): "not a job and its queue",
        forger.row("run/kwargs", json.dumps({"args": [TALK], "kwargs": {"queue": "gpu", "x": 1}})): "not a job",
        forger.row("run/name", name="os.system"): "its name is 'os.system'",
        forger.row("run/temp", name="<temp>.talk"): "its name is '<temp>.talk'",
        forger.row("run/class", class_name="Job"): "its class_name is 'Job'",
        forger.row("run/config", class_name="Job", config_name="default"): "its class_name",
        forger.row("run/roles", authenticated_roles="["): "its authenticated_roles",
        forger.row("run/step", unknown): "step: expected one of",
        forger.row("run/../../etc", ""): "is not JSON",
        forger.row("run/flow", name="flow"): "no such flow",
    }
    farm.start("w0", "c0")
    farm.queue.submit([Job(id="run/z", step="talk", arguments={"text": "still here"})])
    farm.wait_for_end(*rows, "run/z")
    for identity, words in rows.items():
        job = farm.job(identity)
        assert job["state"] == "failed" and words in job["failure"]["reason"], (identity, job)
        assert job["failure"]["status"] == "refused", (identity, job)
    assert farm.job("run/z")["result"]["result"] == "still here"
    assert not forger.sprung.exists()


def test_forged_results_of_steps_fail_their_job(farm: Farm) -> None:
    forger = Forger(farm)
    step = {"function_id": 1, "function_name": "attempt 1", "retention_timestamp": 1}
    forged: dict[str, dict[str, Any]] = {
        "output": {"output": forger.trap, "serialization": "py_pickle"},
        "error": {"error": forger.trap, "serialization": "py_pickle"},
        "unnamed": {"output": forger.trap},
        "portable": {"output": '{"status": "done", "result": 1}', "serialization": "portable_json"},
        "number": {"output": "5", "serialization": OURS},
        "raised": {"error": "5", "serialization": OURS},
    }
    for name, columns in forged.items():
        forger.row(f"run/{name}")
        forger.insert("operation_outputs", workflow_uuid=f"run/{name}", **step, **columns)
    farm.start("w0")
    farm.wait_for_end(*(f"run/{name}" for name in forged))
    assert {name: farm.job(f"run/{name}")["state"] for name in forged} == dict.fromkeys(forged, "failed")
    assert not forger.sprung.exists()


def test_no_reader_of_the_database_unpickles(farm: Farm, capsys: pytest.CaptureFixture[str]) -> None:
    forger = Forger(farm)
    trap = {"serialization": "py_pickle"}
    ended = {"executor_id": "w0", "completed_at": 1_700_000_000_000}
    forger.row("run/done", forger.trap, status="SUCCESS", **trap, **ended)
    forger.row("run/failed", forger.trap, status="ERROR", **trap, **ended)
    forger.row("run/list", "[]", status="ERROR", **ended)
    forger.insert("workflow_output", workflow_uuid="run/done", output=forger.trap, retention_timestamp=1)
    forger.insert("workflow_output", workflow_uuid="run/failed", error=forger.trap, retention_timestamp=1)
    forger.insert("workflow_output", workflow_uuid="run/list", error="[1]", output="[1]", retention_timestamp=1)
    forger.insert(
        "operation_outputs",
        **{"workflow_uuid": "run/done", "function_id": 1, "function_name": "s", "retention_timestamp": 1},
        output=forger.trap,
        **trap,
    )
    forger.insert("workflow_events", workflow_uuid="run/done", key="k", value=forger.trap, **trap)
    history = {"function_id": 1, "key": "k", "value": forger.trap}
    forger.insert("workflow_events_history", workflow_uuid="run/done", **history, **trap)
    forger.insert("notifications", destination_uuid="run/done", topic="t", message=forger.trap, **trap)
    forger.insert("streams", workflow_uuid="run/done", key="s", value=forger.trap, offset=0, function_id=1, **trap)
    forger.insert(
        "workflow_schedules",
        **{"schedule_id": "1", "schedule_name": "n", "workflow_name": "job", "schedule": "* * * * *"},
        context=forger.trap,
    )
    client = DBOSClient(
        system_database_engine=engine(checked_url(farm.url)), serializer=JsonSerializer(), use_listen_notify=False
    )
    system = client._sys_db
    readers = [
        lambda: client.list_workflows(),
        lambda: client.retrieve_workflow("run/done").get_result(),
        lambda: client.retrieve_workflow("run/failed").get_result(),
        lambda: client.list_workflow_steps("run/done"),
        lambda: client.get_event("run/done", "k", timeout_seconds=1),
        lambda: system.get_all_events("run/done"),
        lambda: list(client.read_stream("run/done", "s")),
        lambda: client.list_schedules(),
        lambda: client.fork_workflow("run/done", 2),
    ]
    for read in readers:
        with contextlib.suppress(Exception):
            read()
    client.destroy()
    for command in (["status"], ["retry", "run"], ["cancel", "run"], *(["logs", f"run/{n}"] for n in ("done", "list"))):
        main([*command, "--db", farm.url, "--folder", str(farm.folder)])
    assert "Traceback" not in capsys.readouterr().err
    assert not forger.sprung.exists()


def test_rows_of_any_content_are_listed_without_a_traceback(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """SQLite keeps anything in any column."""
    with open_farm(tmp_path) as farm:
        forger = Forger(farm)
        forger.row("run/a", "[", status="ERROR", created_at="abc", completed_at="xyz", started_at_epoch_ms="q")
        forger.row("run/b\x1b[2J", status="SUCCESS", completed_at=b"\x80", executor_id="e\x1b[31m")
        forger.row("run/c", status="PENDING", executor_id=b"\xff/\x00..", started_at_epoch_ms="zz")
        forger.row("run/d", status="ODD\x1b[2J", name=None)
        forger.row("run/e", status=b"\x80", created_at=1e300)
        forger.row("run/f", json.dumps({"args": [{"arguments": 5}]}), status="ERROR", completed_at=-5)
        forger.row("run/g", status="SUCCESS", completed_at=1e18, output="5")
        forger.row("../../x", status="PENDING", executor_id="..")
        forger.insert("workflow_output", workflow_uuid="run/f", error=json.dumps({"error": {"status": [1]}}))
    jobs = [["logs", f"run/{name}"] for name in "acefg"]
    for words in (
        ["status"],
        ["status", "--run", "run"],
        ["status", "--jobs"],
        *jobs,
        ["retry", "run"],
        ["cancel", "run"],
    ):
        main([*words, "--folder", str(tmp_path)])
    out, err = capsys.readouterr()
    assert "Traceback" not in err and "\x1b" not in out + err and "run/f" in out


@pytest.mark.parametrize("text", ["5", '"x"', "[]", '{"error": []}', "{", None, b"\x80", "9" * 5000, "[" * 10**6])
def test_the_serializer_returns_a_value_or_says_that_the_row_is_unreadable(text: Any) -> None:
    with contextlib.suppress(UnreadableRow):
        JsonSerializer().deserialize(text)


def test_the_trap_is_one(tmp_path: Path) -> None:
    pickle.loads(pickle.dumps(Trap(tmp_path / "sprung")))
    assert os.path.exists(tmp_path / "sprung")
