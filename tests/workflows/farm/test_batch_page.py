"""The page of a batch while it proceeds, after its end, and after its processes were killed."""

import csv
import io
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from registration.errors import InputError
from tests.workflows.farm.harness import ROOT, open_farm
from workflows.cli.app import main
from workflows.engine.client import QueueClient
from workflows.engine.database import default_url
from workflows.engine.jobs import Job
from workflows.engine.process import migrate
from workflows.engine.reader import JobRow
from workflows.farm import batch_page
from workflows.farm.batch_page import BatchPage
from workflows.records.store import Store


def read_rows(file: Path) -> dict[str, dict[str, str]]:
    return {row["capture"]: row for row in csv.DictReader(io.StringIO(file.read_text()))}


def statuses(file: Path) -> dict[str, str]:
    return {name: row["status"] for name, row in read_rows(file).items()}


def test_the_page_of_a_batch_is_true_at_all_times(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A job that is done, one that is refused, one that runs, one that waits; then the farm is killed."""
    store = tmp_path / "farm" / "june"

    def job(name: str, seconds: float) -> Job:
        arguments = {"store": str(store), "key": name, "seconds": seconds}
        return Job(id=f"june/{name}", step="work", arguments=arguments)

    monkeypatch.setattr(batch_page, "PERIOD_S", 3600.0)
    (tmp_path / "farm").mkdir()
    with open_farm(tmp_path / "farm") as farm:
        page = BatchPage(farm.url, "june", str(store))
        farm.queue.submit([job("ann/rest", 0.0), Job(id="june/bob/rest", step="refuse")])
        page.update(farm.reader.counts("june", kind="job"))
        table, html = store / "captures.csv", store / "index.html"
        assert statuses(table) == {"ann/rest": "waiting", "bob/rest": "waiting"} and not page.problem
        farm.start("w0")
        farm.wait_for_end("june/ann/rest", "june/bob/rest")
        farm.queue.submit([job("cyd/rest", 60.0), job("dan/rest", 60.0)])
        farm.wait_until(lambda: "running" in farm.reader.counts("june", kind="job"))
        before = table.read_text()
        page.update(farm.reader.counts("june", kind="job"))
        assert table.read_text() == before  # written a moment ago
        page.write()
        running = {"ann/rest": "converged", "bob/rest": "bad input", "cyd/rest": "running", "dan/rest": "waiting"}
        assert statuses(table) == running
        farm.kill("w0")
        page.write()  # the worker's lock tells
        assert statuses(table) == {**running, "cyd/rest": "interrupted"} and "is written again" in html.read_text()
        page.write(live=False)
        assert statuses(table) == {**running, "cyd/rest": "interrupted"}
    rows = read_rows(table)
    assert list(rows) == ["bob/rest", "ann/rest", "cyd/rest", "dan/rest"]
    assert "mend it" in rows["bob/rest"]["reason"] and rows["bob/rest"]["report"] == ""
    attempt = Store(store).find("ann/rest").attempt  # type: ignore[union-attr]
    assert rows["ann/rest"]["report"] == f"ann/rest/{attempt}/registration/report.html"
    text = html.read_text()
    assert f'href="ann/rest/{attempt}/registration/report.html"' in text and "interrupted, 1" in text
    report = Store(store).verify()
    assert report.is_sound and not [name for name in report.orphaned if name.endswith((".html", ".csv"))]


def a_job(state: str, result: Any = None, failure: dict[str, Any] | None = None, spec: Any = None) -> JobRow:
    spec = {"arguments": {"capture": "s3://u:secret@b/c"}} if spec is None else spec
    return JobRow(
        id="r/a/b",
        kind="job",
        state=state,
        executor=None,
        spec=spec,
        result=result,
        failure=failure,
        created=0.0,
        ended=None,
    )


@pytest.fixture
def page(tmp_path: Path) -> BatchPage:
    migrate(default_url(tmp_path))
    return BatchPage(default_url(tmp_path), "r", str(tmp_path / "store"))


def test_rows_of_others_are_shown_and_link_nowhere_else(page: BatchPage) -> None:
    """Anyone who can write to the queue can write a row."""
    hostile = {"attempt": "../../etc", "about": {"status": 7, "seconds": "x", "figures": [1], "thumbnail": True}}
    row = page._row(a_job("done", {"result": hostile}), live=True)
    assert (row.status, row.report, row.thumbnail, row.seconds, row.figures) == ("done", None, None, None, {})
    assert "secret" not in row.source
    for result in (None, {"result": 3}, {"result": {"about": [], "attempt": None}}):
        assert page._row(a_job("done", result), live=True).status == "done"
    assert page._row(a_job("waiting", spec={}), live=True).name == "a/b"


def test_a_registration_that_failed_is_linked(page: BatchPage, tmp_path: Path) -> None:
    failed = a_job("failed", failure={"status": "unusable", "reason": "no face"})
    assert page._row(failed, live=True).report is None
    store = Store(tmp_path / "store")
    artifact = store.produce("a/b", input_hash="h", make=lambda folder: {"status": "failed", "thumbnail": True})
    row = page._row(failed, live=True)
    assert row.report == f"a/b/{artifact.attempt}/registration/report.html" and row.status == "unusable"
    assert row.thumbnail == f"a/b/{artifact.attempt}/thumbnail.jpg"
    died = a_job("failed", failure={"status": "died", "reason": "out of memory"})
    assert page._row(died, live=True).report is None  # what is published is of an earlier job


def test_a_run_of_another_name_has_a_page_of_its_own(tmp_path: Path) -> None:
    migrate(url := default_url(tmp_path))
    page = BatchPage(url, "part/2", str(tmp_path / "store"))
    page.write()
    assert {path.name for path in (tmp_path / "store").iterdir()} == {"part_2.html", "part_2.csv"}
    with pytest.raises(InputError):
        BatchPage(url, "../x", str(tmp_path / "store"))


def test_captures_without_a_job_are_shown(tmp_path: Path) -> None:
    migrate(url := default_url(tmp_path))
    page = BatchPage(url, "r", str(tmp_path / "r"), {"/data/2/ann/rest": "its key is that of /data/1/ann/rest"})
    page.write()
    row = read_rows(tmp_path / "r" / "captures.csv")["/data/2/ann/rest"]
    assert (row["state"], row["status"]) == ("failed", "bad input") and "its key is" in row["reason"]


def test_status_writes_the_page_of_a_batch(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    migrate(url := default_url(tmp_path))
    queue, store = QueueClient(url), tmp_path / "results" / "june"
    queue.submit([Job(id="june/a/b", step="register stored", arguments={"store": str(store), "capture": "/c"})])
    queue.close()
    folder = ["--folder", str(tmp_path)]
    assert main(["status", *folder, "--run", "june", "--page", str(store)]) == 0
    assert str(store / "index.html") in capsys.readouterr().out
    assert statuses(store / "captures.csv") == {"a/b": "waiting"}
    for words in (["--page", str(store)], ["--run", "june", "--page", str(tmp_path / "elsewhere")]):
        assert main(["status", *folder, *words]) == 2
        assert "no batch to write a page of" in capsys.readouterr().err
    assert not (tmp_path / "elsewhere").exists()


def test_status_without_a_page_imports_nothing_slow(tmp_path: Path) -> None:
    migrate(default_url(tmp_path))
    code = "import sys; from workflows.cli.app import main; main(sys.argv[1:]); print('torch' in sys.modules)"
    command = [sys.executable, "-c", code, "status", "--folder", str(tmp_path)]
    assert subprocess.check_output(command, cwd=ROOT, text=True).splitlines()[-1] == "False"


def test_a_store_that_cannot_be_written_does_not_end_a_batch(tmp_path: Path) -> None:
    migrate(url := default_url(tmp_path))
    (tmp_path / "store").write_text("a file")
    page = BatchPage(url, "store", str(tmp_path / "store"))
    page.write()
    assert "cannot be written" in page.problem and "index.html" in page.problem
    QueueClient(url).close()
