"""Passwords of queues and keys of stores, of any characters, appear in no output, row, file or command line."""

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from urllib.parse import quote

import pytest
import sqlalchemy as sa

from bench.support.postgres_server import Server, programs, server
from tests.conftest import FIXTURES, ROOT
from tests.registration.capture import small
from tests.workflows.farm.harness import children_of
from workflows.cli.app import main
from workflows.engine.database import checked_url, engine, redacted_url, with_environments_password, without_secrets
from workflows.ids import redact

CANARY = "cañary"
PASSWORDS = ("plain-{}", "a/{}", "a@{}", "'{}'\"", "{} b", "a:{}?#%5&=", "{}@h/d?x=y", "100%-{}", "$A{}$$", "[{}]")
URLS = tuple(f"postgresql://me:{word.format(CANARY)}@127.0.0.1:9/queue" for word in PASSWORDS)


@pytest.fixture(scope="module")
def postgres() -> Iterator[Server]:
    if programs() is None:
        pytest.skip("no PostgreSQL here")
    with server() as running:
        yield running


@pytest.mark.parametrize("url", URLS)
def test_a_password_of_any_characters_is_read_whole_and_not_printed(url: str) -> None:
    checked = checked_url(url)
    read = sa.make_url(checked)
    password = url.removeprefix("postgresql://me:").removesuffix("@127.0.0.1:9/queue")
    assert (read.password, read.host, read.port, read.database) == (password, "127.0.0.1", 9, "queue")
    assert checked_url(checked) == checked
    for text in (redacted_url(url), redacted_url(checked), without_secrets(f"no {read.password}, {checked}", checked)):
        assert "ary" not in text and "me:***@127.0.0.1" in text.replace("no ***, ", "")
    if " " not in url:  # in free text nothing else says where a password ends
        assert "ary" not in redact(f"cannot reach {url}, {url}")


@pytest.mark.parametrize(
    "url",
    [
        f"postgresql://h/d?user=me&password={CANARY}",
        f"postgresql://me@h/d?sslpassword={CANARY}&application_name=x",
        f"mysql://me:{CANARY}@h/d",
        f"postgresql://me:{CANARY}",
        f"postgresql:/me:{CANARY}@h/d",
        f"postgresql://me:{CANARY}@h",
        f"me:{CANARY}@h/d",
        f"{CANARY}",
    ],
)
def test_other_urls_are_printed_without_their_password(url: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert CANARY not in redacted_url(url)
    main(["migrate", "--db", url])
    out, err = capsys.readouterr()
    assert CANARY not in out + err and "Traceback" not in err


def test_the_environments_password_completes_a_url(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PGPASSWORD", "a/@:ä")
    completed = with_environments_password(checked_url("postgresql://me@h:5/d?connect_timeout=3"))
    assert sa.make_url(completed).password == "a/@:ä" and completed.endswith("@h:5/d?connect_timeout=3")
    assert with_environments_password(checked_url("postgresql://me:own@h/d")).count("own") == 1
    assert with_environments_password("sqlite:////x") == "sqlite:////x"


@pytest.mark.parametrize(
    "text", ["s3://AKIA:{}@bucket/x", "s3://AKIA:a/{}@b/x", "x://h/?Signature={}&b=1", "password='{} b' x"]
)
def test_keys_in_any_text_are_removed(text: str) -> None:
    assert CANARY not in redact(text.format(CANARY))
    assert (
        json.loads(redact(json.dumps({"a": text.format(CANARY), "b": "x@y", "c": ["d:e@f"]}, indent=1)))["b"] == "x@y"
    )


@pytest.mark.parametrize(
    "words",
    [
        ["store", "verify", "s3://AKIA:{}@bucket/x"],
        ["store", "verify", "s3://bucket/x?secret={}"],
        ["store", "verify", "s3:///{}"],
        ["batch", "s3://AKIA:{}@b/capture", "--model", "m.npz", "--out", "out"],
        ["batch", "{capture}", "--model", "{model}", "--out", "s3://AKIA:a/{}@b/out"],
        ["batch", "{capture}", "--model", "s3://AKIA:{}@b/m.npz", "--out", "out"],
        ["worker", "--root", "s3://AKIA:{}@bucket"],
    ],
)
def test_keys_in_urls_of_stores_are_refused(
    words: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    capture = small.make(tmp_path / "s" / "capture")
    known = {"{capture}": str(capture), "{model}": str(FIXTURES / "tiny_gnm.npz"), "{}": CANARY}
    for form, value in known.items():
        words = [word.replace(form, value) for word in words]
    assert main(words) == 2
    out, err = capsys.readouterr()
    assert "expected" in err and (CANARY not in out + err or words[2] == f"s3:///{CANARY}")


def test_a_farm_keeps_its_password_to_itself(
    postgres: Server, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    """Commands, a worker and its child on a real server: output, logs, rows, files, command lines, environments."""
    password = f"a/{CANARY}@'\" x"
    host = postgres.url.rpartition("@")[2]
    monkeypatch.setenv("GNMREG_DB", f"postgresql://farm:{password}@{host}")
    capture = small.make(tmp_path / "s" / "capture")
    farm = ["--folder", str(tmp_path / "farm")]
    assert main(["migrate", *farm]) == 0
    (tmp_path / "out").mkdir()
    model = shutil.copy(FIXTURES / "tiny_gnm.npz", tmp_path)
    batch = [str(capture), "--model", str(model), "--out", str(tmp_path / "out")]
    assert main(["batch", *batch, *farm]) == 0
    worker = subprocess.Popen(
        [sys.executable, "-m", "workflows.cli", "worker", *farm, "--root", str(tmp_path)],
        cwd=ROOT,
        stdout=(tmp_path / "worker.out").open("w"),
        stderr=subprocess.STDOUT,
    )
    try:
        deadline = time.monotonic() + 25
        while not list((tmp_path / "farm" / "logs").rglob("*.log")) and worker.poll() is None:
            assert time.monotonic() < deadline, (tmp_path / "worker.out").read_text()
            time.sleep(0.2)
        processes = [worker.pid, *children_of(worker.pid)]
        lines = [Path(f"/proc/{pid}/cmdline").read_text("utf-8", "replace") for pid in processes]
        environments = [Path(f"/proc/{pid}/environ").read_text("utf-8", "replace") for pid in processes[1:]]
    finally:
        worker.send_signal(signal.SIGTERM)
        worker.wait()
    for words in (["status"], ["retry", "out"], ["logs", "out/s/capture"], ["cancel", "out"]):
        main([*words, *farm])
    with engine(checked_url(os.environ["GNMREG_DB"])).connect() as connection:
        names = connection.execute(sa.text("SELECT tablename FROM pg_tables WHERE schemaname = 'dbos'")).scalars().all()
        rows = [str(connection.execute(sa.text(f"SELECT * FROM dbos.{name}")).fetchall()) for name in names]
    files = [file.read_bytes().decode("utf-8", "replace") for file in tmp_path.rglob("*") if file.is_file()]
    assert len(rows) > 5 and len(environments) > 0 and "takes jobs" in (tmp_path / "worker.out").read_text()
    for text in (*capfd.readouterr(), *lines, *environments, *rows, *files):
        assert CANARY not in text and quote(CANARY) not in text
