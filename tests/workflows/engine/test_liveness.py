import signal
import sqlite3
import subprocess
import sys
from pathlib import Path

import pytest

from registration.errors import InputError
from tests.workflows.farm.harness import ROOT
from workflows.engine.database import checked_url, default_url, prepare, reading, redacted_url
from workflows.engine.liveness import FileLocks, Liveness, LivenessTimeouts

HOLD = """
import sys, time
from workflows.engine.liveness import FileLocks
locks = FileLocks(sys.argv[1])
assert locks.take("w")
print("held", flush=True)
time.sleep(60)
"""


def holder(url: str) -> subprocess.Popen[str]:
    held = FileLocks(url)
    process = subprocess.Popen([sys.executable, "-c", HOLD, url], cwd=ROOT, stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None and process.stdout.readline() == "held\n"
    assert held.free(["w", "never"]) == {"never"}
    return process


def test_a_lock_is_held_while_its_process_lives_even_frozen(tmp_path: Path) -> None:
    url = default_url(tmp_path)
    process, locks = holder(url), FileLocks(url)
    try:
        process.send_signal(signal.SIGSTOP)
        assert not locks.free(["w"])
        with pytest.raises(InputError, match="Another process has this executor id"):
            Liveness(url).join(["w"])
        assert Liveness(url).join(["w", "v"]) == "v"
    finally:
        process.kill()
        process.wait()
    assert locks.free(["w"]) == {"w"}


def test_a_dead_executor_is_reported_after_the_release_timeout(tmp_path: Path) -> None:
    liveness = Liveness(default_url(tmp_path), LivenessTimeouts(release_s=15.0, uptime_s=0.0))
    assert liveness.join(["me"]) == "me"
    assert liveness.dead(["w", "me"], now=100.0) == []
    assert liveness.dead(["w", "me"], now=114.0) == []
    assert liveness.dead(["w", "me"], now=115.0) == ["w"]


def test_an_executor_that_came_back_restarts_the_timeout(tmp_path: Path) -> None:
    url = default_url(tmp_path)
    liveness = Liveness(url, LivenessTimeouts(release_s=15.0, uptime_s=0.0))
    assert liveness.dead(["w"], now=100.0) == []
    process = holder(url)
    assert liveness.dead(["w"], now=110.0) == []
    process.kill()
    process.wait()
    assert liveness.dead(["w"], now=115.0) == []
    assert liveness.dead(["w"], now=130.0) == ["w"]


def test_no_executor_is_dead_before_the_minimum_uptime_of_the_server(tmp_path: Path) -> None:
    liveness = Liveness(default_url(tmp_path), LivenessTimeouts(release_s=0.0, uptime_s=60.0))
    liveness._locks.uptime_s = lambda: 59.0  # type: ignore[method-assign]
    assert liveness.dead(["w"], now=1.0) == []
    liveness._locks.uptime_s = lambda: 60.0  # type: ignore[method-assign]
    assert liveness.dead(["w"], now=1.0) == ["w"]


def test_sqlite_gets_its_write_ahead_log_and_readers_cannot_write(tmp_path: Path) -> None:
    url = default_url(tmp_path / "new")
    prepare(url)
    assert (tmp_path / "new" / "queue.sqlite").read_bytes()[18:20] == b"\x02\x02"  # the header's WAL flag
    with reading(url) as select, pytest.raises(sqlite3.OperationalError, match="readonly"):
        select("CREATE TABLE x (y)", {})


@pytest.mark.parametrize(
    "url", ["", "queue.sqlite", "mysql://h/d", "sqlite://", "sqlite:///:memory:", "postgresql://h"]
)
def test_unsupported_urls_are_refused(url: str) -> None:
    with pytest.raises(InputError):
        checked_url(url)


def test_a_network_disk_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("workflows.engine.database._filesystem", lambda file: "nfs4")
    with pytest.raises(InputError, match="network disk"):
        checked_url(default_url(tmp_path))


def test_the_error_for_an_unreachable_server_hides_the_password() -> None:
    url = "postgresql://me:secret@127.0.0.1:9/queue"
    with pytest.raises(InputError) as refused:
        prepare(checked_url(url))
    assert "secret" not in str(refused.value) + redacted_url(url)
    assert refused.value.__cause__ is None
