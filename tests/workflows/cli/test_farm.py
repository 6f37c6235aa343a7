"""Commands of an operator on a queue without workers; `--local` with real registrations is in the slow tests."""

import csv
import os
import re
import signal
import sqlite3
import subprocess
import sys
import time
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest

from registration.errors import InputError
from registration.options import RegisterOptions
from tests.registration.capture import small
from tests.registration.register import synthetic
from tests.workflows.farm.harness import ROOT, alive, interruptible
from workflows.cli.app import main
from workflows.engine.client import QueueClient, Submission
from workflows.engine.database import default_url
from workflows.engine.jobs import VERSION, FlowJob
from workflows.engine.liveness import FileLocks
from workflows.engine.reader import QueueReader
from workflows.farm.batch import batch_jobs, submit_batch
from workflows.records.store import Store


@pytest.fixture
def captures(tmp_path: Path) -> Path:
    for name in ("ann/rest", "bob/rest"):
        small.make(tmp_path / "captures" / name)
    return tmp_path / "captures"


def batch(captures: Path, *more: str) -> int:
    folders = [str(captures / name / "rest") for name in ("ann", "bob")]
    out = str(captures.parent / "out")
    return main(["batch", *folders, *more, "--model", str(synthetic.MODEL), "--out", out, "--folder", str(captures)])


def test_a_batch_is_submitted_shown_cancelled_and_requeued(captures: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = ["--folder", str(captures)]
    assert main(["migrate", *folder]) == 0
    assert batch(captures) == 0 and "out: 2 captures are in the queue" in capsys.readouterr().out
    assert batch(captures) == 0
    assert main(["status", *folder]) == 0
    text = capsys.readouterr().out
    assert "jobs: 2 (2 waiting)" in text and "flows: 1 (1 waiting)" in text and "of 10,000" in text
    assert main(["logs", "out/ann/rest", *folder]) == 0
    assert "out/ann/rest: waiting" in capsys.readouterr().out
    assert main(["cancel", "out/ann", *folder]) == 0
    assert main(["cancel", "out", *folder]) == 0
    assert capsys.readouterr().out == "1 cancelled\n2 cancelled\n"
    assert main(["retry", "out", *folder]) == 0
    assert main(["retry", "out", "--cancelled", *folder]) == 0
    assert re.search("^0 requeued\n3 requeued", capsys.readouterr().out)
    assert main(["status", "--run", "out", *folder]) == 0
    assert "jobs: 2 (2 waiting)" in capsys.readouterr().out


def test_unusable_batches_are_refused(captures: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert batch(captures) == 2
    assert "There is no queue" in capsys.readouterr().err
    main(["migrate", "--folder", str(captures)])
    assert batch(captures, f"@{captures}/none") == 2
    assert "cannot be read" in capsys.readouterr().err
    model = ["--model", str(synthetic.MODEL), "--out", str(captures.parent / "out"), "--folder", str(captures)]
    assert main(["batch", str(captures / "nobody"), *model]) == 2
    assert "No capture can be found" in capsys.readouterr().err
    assert main(["logs", "out/none", "--folder", str(captures)]) == 2
    assert main(["cancel", "../x", "--folder", str(captures)]) == 2
    with pytest.raises(SystemExit) as stop:
        main(["worker", "--queue", "nothing", "--folder", str(captures)])
    assert stop.value.code == 2
    error = capsys.readouterr().err
    assert "Traceback" not in error and "rebuild" in error


def test_a_password_is_never_printed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    environment = {**os.environ, "GNMREG_DB": "postgresql://me:secret@127.0.0.1:9/queue"}
    for command in ("status", "worker", "migrate", "coordinator"):
        done = subprocess.run(
            [sys.executable, "-m", "workflows.cli", command, "--folder", str(tmp_path)],
            cwd=ROOT,
            env=environment,
            capture_output=True,
            text=True,
        )
        assert done.returncode == 2, done.stderr
        assert "secret" not in done.stdout + done.stderr and "127.0.0.1" in done.stderr


def test_store_verify_fails_on_altered_files(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    store = Store(tmp_path)
    artifact = store.produce("a", input_hash="w", make=lambda folder: {"n": (folder / "f").write_text("x")})
    assert main(["store", "verify", str(tmp_path)]) == 0
    assert "1 artifacts; 0 files missing, 0 altered, 0 orphaned; 0 manifests unreadable" in capsys.readouterr().out
    (tmp_path / "a" / artifact.attempt / "f").write_text("y")
    assert main(["store", "verify", str(tmp_path)]) == 1
    assert f"altered: a/{artifact.attempt}/f" in capsys.readouterr().out


def test_retiring_an_unknown_run_fails(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    Store(tmp_path).produce("june/it00/x", input_hash="w", make=lambda folder: {"n": (folder / "f").write_text("x")})
    folder = ["--keep", "1", "--folder", str(tmp_path / "farm")]
    main(["migrate", "--folder", str(tmp_path / "farm")])
    assert main(["store", "retire", str(tmp_path), "jun", *folder]) == 2
    assert "one of june" in capsys.readouterr().err
    assert main(["store", "retire", str(tmp_path), "june", *folder]) == 0
    assert "nothing to delete" in capsys.readouterr().out


def test_names_that_are_not_in_the_queue_fail(captures: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = ["--folder", str(captures)]
    main(["migrate", *folder])
    batch(captures)
    commands = (
        ["status", "--run", "otu"],
        ["status", "--jobs", "--subject", "anm"],
        ["cancel", "otu"],
        ["retry", "otu"],
    )
    for words in (*commands, ["logs", "otu"], ["debug", "out/anm/rest", "--out", str(captures / "d")]):
        assert main([*words, *folder]) == 2
        assert "did you mean" in capsys.readouterr().err
    assert QueueReader(default_url(captures)).counts("out", kind="job") == {"waiting": 2}


def test_jobs_are_listed_and_found(captures: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = ["--folder", str(captures)]
    main(["migrate", *folder])
    batch(captures)
    capsys.readouterr()
    assert main(["status", "--jobs", "--state", "waiting", "--text", "BOB", *folder]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].split() == ["id", "state", "since", "stage", "capture"]
    assert lines[1].split()[:2] == ["out/bob/rest", "waiting"] and lines[1].endswith(str(captures / "bob" / "rest"))
    assert lines[2:] == ["1 of 1 jobs"]
    assert main(["logs", "bob/rest", *folder]) == 0 and main(["logs", "out", *folder]) == 0
    text = capsys.readouterr().out
    assert "out/bob/rest: waiting" in text and "out: waiting; jobs: 2 (2 waiting)" in text
    assert main(["debug", "out", "--out", str(captures / "d"), *folder]) == 2
    assert "name one of out/" in capsys.readouterr().err


def test_jobs_are_named_by_the_last_two_folders(captures: Path) -> None:
    locations = [f"{captures}/ann/rest", f"{captures}/bob/rest", "s3://bucket/c/cyd/rest"]
    jobs = batch_jobs(locations, model=str(synthetic.MODEL), out="s3://bucket/results/june")
    assert [job.id for job in jobs.jobs] == ["june/ann/rest", "june/bob/rest", "june/cyd/rest"]
    assert "s3://bucket/results/june" in jobs.roots and f"{captures}/ann" in jobs.roots


def test_bad_entries_are_listed_and_the_others_are_submitted(
    captures: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    main(["migrate", "--folder", str(captures)])
    same = small.make(captures / "again" / "ann" / "rest")
    odd = small.make(captures / "Björn K" / "rest")
    assert batch(captures, str(captures / "nobody"), str(captures / "ann" / "rest" / ".." / "rest"), str(same)) == 1
    printed = capsys.readouterr()
    assert "3 captures are in the queue: 3 new" in printed.out
    assert f"bad input: {captures}/nobody: no folder with capture.toml" in printed.err
    assert f"bad input, left out: {same}" in printed.err and f"those of {captures}/ann/rest" in printed.err
    assert batch(captures, str(odd)) == 0
    assert QueueReader(default_url(captures)).counts("out", kind="job") == {"waiting": 4}
    assert main(["logs", "out/Bj_rn_K/rest", "--folder", str(captures)]) == 0


@pytest.mark.slow
def test_a_local_farm_is_interrupted_and_resumes(tmp_path: Path) -> None:
    """Ctrl-C ends all processes; the same command registers the rest, and no finished capture again."""
    for name in ("neutral", "smile"):
        synthetic.make(tmp_path / "captures" / name, name)
    (tmp_path / "captures" / "bad").mkdir()
    (tmp_path / "captures" / "bad" / "capture.toml").write_text("x = 1")
    folders = [str(tmp_path / "captures" / name) for name in ("bad", "neutral", "smile")]
    command = [sys.executable, "-m", "workflows.cli", "batch", *folders, "--model", str(synthetic.MODEL)]
    command += ["--out", str(tmp_path / "out"), "--local", "--workers", "1"]
    pipe = subprocess.PIPE
    first = subprocess.Popen(command, cwd=ROOT, stderr=pipe, stdout=pipe, text=True, preexec_fn=interruptible)
    url = default_url(tmp_path / "out.farm")
    deadline = time.monotonic() + 500
    while not _done(url) and time.monotonic() < deadline:
        time.sleep(0.5)
    pids = _processes_of(str(tmp_path))
    first.send_signal(signal.SIGINT)
    assert first.wait(timeout=60) == 130
    assert len(pids) >= 3 and not any(map(alive, pids))
    table = tmp_path / "out" / "captures.csv"
    assert "running" not in table.read_text()
    second = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=600)
    assert second.returncode == 1 and "jobs: 3 (2 done, 1 failed)" in second.stdout, second.stdout + second.stderr
    assert 'capture.toml lacks "subject"' in second.stdout
    report = Store(tmp_path / "out").verify()
    assert report.is_sound and report.artifacts == 2 and not _processes_of(str(tmp_path))
    with table.open() as file:
        bad, *registered = csv.DictReader(file)
    assert (bad["capture"], bad["status"]) == ("captures/bad", "bad input")
    assert {row["status"] for row in registered} <= {"converged", "stopped"}
    for row in registered:
        assert (tmp_path / "out" / row["report"]).is_file() and float(row["scan_to_mesh_face_mean_mm"]) < 5
        assert (tmp_path / "out" / row["report"]).parents[1].joinpath("thumbnail.jpg").is_file()


def _done(url: str) -> bool:
    try:
        return QueueReader(url).counts("out").get("done", 0) > 0
    except Exception:  # the queue does not exist yet
        return False


def _processes_of(word: str) -> list[int]:
    """Return the ids of processes whose command line contains a word."""
    pids = []
    for path in Path("/proc").glob("[0-9]*"):
        try:
            if word in (path / "cmdline").read_text() and int(path.name) != os.getpid():
                pids.append(int(path.name))
        except OSError:
            continue
    return [pid for pid in pids if alive(pid)]


def submit(captures: Path, *names: str, **settings: Any) -> Submission:
    options = RegisterOptions(**settings)
    folders = [f"{captures}/{name}/rest" for name in names]
    model, out = str(synthetic.MODEL), str(captures.parent / "out")
    return submit_batch(default_url(captures), batch_jobs(folders, run="r", model=model, out=out, options=options))


def recipe(captures: Path, job: str) -> str:
    return QueueReader(default_url(captures)).rows([job])[job].spec["arguments"]["options"]["recipe"]


def test_captures_are_added_to_a_batch_that_ended(captures: Path) -> None:
    main(["migrate", "--folder", str(captures)])
    assert submit(captures, "ann") == Submission(new=1)
    queue, reader = QueueClient(default_url(captures)), QueueReader(default_url(captures))
    queue.cancel("r")
    assert submit(captures, "ann", "bob") == Submission(new=1, again=1)
    assert reader.rows(["r"])["r"].state == "waiting"
    assert reader.counts("r") == {"waiting": 2}


def test_a_batch_with_other_settings_replaces_waiting_and_ended_jobs(captures: Path) -> None:
    main(["migrate", "--folder", str(captures)])
    submit(captures, "ann", "bob", recipe="draft")
    assert submit(captures, "ann", "bob", recipe="draft") == Submission(waiting=2)
    assert submit(captures, "ann", recipe="preview") == Submission(again=1)
    assert (recipe(captures, "r/ann/rest"), recipe(captures, "r/bob/rest")) == ("preview", "draft")
    set_rows(captures, status="SUCCESS")
    assert submit(captures, "ann", "bob", recipe="preview") == Submission(again=2)  # their inputs may have changed
    assert recipe(captures, "r/bob/rest") == "preview"
    assert QueueReader(default_url(captures)).counts("r", kind="job") == {"waiting": 2}
    set_rows(captures, status="ERROR")
    assert submit(captures, "ann", recipe="studio") == Submission(again=1)
    QueueClient(default_url(captures)).retry("r")
    assert recipe(captures, "r/ann/rest") == "studio"


def test_jobs_that_run_with_other_settings_are_not_replaced(captures: Path) -> None:
    main(["migrate", "--folder", str(captures)])
    submit(captures, "ann", "bob", recipe="draft")
    set_rows(captures, status="PENDING", executor_id="living")
    locks = FileLocks(default_url(captures))
    assert locks.take("living")
    assert submit(captures, "ann", recipe="draft") == Submission(waiting=1)
    with pytest.raises(InputError, match="run with other settings"):
        submit(captures, "ann", "bob", recipe="preview")
    assert recipe(captures, "r/ann/rest") == "draft"
    set_rows(captures, status="PENDING", executor_id="dead")
    assert submit(captures, "ann", "bob", recipe="preview") == Submission(again=2)
    assert recipe(captures, "r/ann/rest") == "preview"


def test_jobs_of_an_earlier_release_are_put_into_the_queue_of_this_one(captures: Path) -> None:
    main(["migrate", "--folder", str(captures)])
    submit(captures, "ann", "bob")
    set_rows(captures, application_version="wf-1")
    with closing(sqlite3.connect(captures / "queue.sqlite")) as database, database:
        change = "UPDATE workflow_status SET application_version = 'wf-1', status = 'SUCCESS' WHERE name = 'flow'"
        database.execute(change)
    assert submit(captures, "ann") == Submission(again=1)
    queue, reader = QueueClient(default_url(captures)), QueueReader(default_url(captures))
    versions = {row.id: row.version for row in reader.listing("r")}
    assert versions == {"r": VERSION, "r/ann/rest": VERSION, "r/bob/rest": "wf-1"}
    queue.cancel("r")
    queue.retry("r", cancelled=True)
    assert {row.version for row in reader.listing("r")} == {VERSION}


def test_the_name_of_a_coregistration_cannot_be_a_batchs(captures: Path) -> None:
    main(["migrate", "--folder", str(captures)])
    flow = FlowJob(id="r", flow="coregister", arguments={"plan": "/p"}, queue="driver")
    QueueClient(default_url(captures)).submit([flow])
    with pytest.raises(InputError, match="no batch"):
        submit(captures, "ann")


def set_rows(captures: Path, **columns: str) -> None:
    """Pretend what workers do to the rows of the jobs."""
    with closing(sqlite3.connect(captures / "queue.sqlite")) as database, database:
        text = ", ".join(f"{name} = :{name}" for name in columns)
        database.execute(f"UPDATE workflow_status SET {text} WHERE name = 'job'", columns)


def test_store_verify_of_a_place_that_is_not_there_fails(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "file").write_text("x")
    for place in (tmp_path / "none", tmp_path / "file"):
        assert main(["store", "verify", str(place)]) == 2
        assert "There is no store" in capsys.readouterr().err
        assert main(["store", "retire", str(place), "run", "--keep", "1", "--folder", str(tmp_path)]) == 2
    (tmp_path / "empty").mkdir()
    assert main(["store", "verify", str(tmp_path / "empty")]) == 0


def test_names_with_escape_sequences_are_shown_not_obeyed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    evil = "a\x1b[2J\u202eb"
    (tmp_path / "store" / evil / "attempt-0").mkdir(parents=True)
    (tmp_path / "store" / evil / "attempt-0" / "f").write_text("x")
    (tmp_path / "logs" / "run").mkdir(parents=True)
    main(["store", "verify", str(tmp_path / "store")])
    main(["store", "verify", str(tmp_path / evil)])
    main(["capture", "check", str(tmp_path / evil)])
    main(["migrate", "--folder", str(tmp_path)])
    main(["status", "--folder", str(tmp_path), "--run", evil])
    main(["logs", evil, "--folder", str(tmp_path)])
    out, err = capsys.readouterr()
    assert r"a\x1b[2J\u202eb" in out and r"a\x1b[2J\u202eb" in err
    assert "\x1b" not in out + err and "\u202e" not in out + err
