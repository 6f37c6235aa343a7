"""The log of decisions: chain, signatures, concurrency, damage, undo."""

import json
import os
import stat
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from registration.errors import InputError
from tests.conftest import ROOT
from tests.workflows.gate import made
from workflows.cli.app import main
from workflows.gate.decisions import START, DecisionLog, Ruling, current, read_log


def ruling(content_id: str = "c1", decision: str = "accept", **changes: str) -> Ruling:
    fields = {"name": "ann/smile", "reason": "fine", "who": "eve", "thresholds": "t", "verdict": "look"}
    return Ruling(content_id=content_id, decision=decision, **{**fields, **changes})


@pytest.fixture
def log(tmp_path: Path) -> DecisionLog:
    log = DecisionLog.of_farm(tmp_path)
    for content_id, decision in (("c1", "accept"), ("c2", "reject"), ("c1", "reject")):
        log.append(ruling(content_id, decision))
    return log


def test_entries_are_chained_signed_and_private(log, tmp_path):
    first, second, third = log.read()
    assert [entry.sequence for entry in (first, second, third)] == [1, 2, 3] and first.previous == START
    assert len({first.previous, second.previous, third.previous}) == 3 and len(third.signature) == 128
    assert stat.S_IMODE(os.stat(log.folder / "key").st_mode) == 0o600
    assert log.file == tmp_path / "gate" / "decisions.jsonl"
    assert DecisionLog.of_farm(tmp_path).verify() == log.head and log.head.sequence == 3
    assert read_log(log.file) == log.read()


def test_an_undo_restores_what_held_before(log):
    assert current(log.read())["c1"].decision == "reject"
    log.append(ruling("c1", "undo"))
    assert current(log.read())["c1"].decision == "accept"
    log.append(ruling("c1", "undo"))
    assert set(current(log.read())) == {"c2"}
    before = log.file.read_bytes()
    with pytest.raises(InputError, match="no decision to undo"):
        log.append(ruling("c1", "undo"))
    assert log.file.read_bytes() == before


def test_no_log_is_no_decision(tmp_path):
    log = DecisionLog.of_farm(tmp_path)
    assert log.read() == () and log.verify().sequence == 0 and log.repair() is None and not list(tmp_path.iterdir())


def changed(number: int, **fields: object):
    def change(rows: list[dict]) -> list[dict]:
        rows[number] |= fields
        return rows

    return change


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (changed(1, decision="accept"), "signature"),
        (changed(0, who="mallory"), "signature"),
        (changed(1, signature="00" * 64), "signature"),
        (changed(1, signature="no"), "signature"),
        (changed(1, sequence=7), "entry 2"),
        (changed(1, more=1), "no such field"),
        (changed(1, decision="maybe"), "one of"),
        (lambda rows: rows[1:], "entry 1"),
        (lambda rows: [rows[0], rows[2]], "entry 2"),
        (lambda rows: [rows[0], rows[2], rows[1]], "entry 2"),
        (lambda rows: [*rows, rows[0]], "entry 4"),
    ],
)
def test_every_change_is_found(log, change, says):
    rows = change(made.lines(log.file))
    log.file.write_text("".join(json.dumps(row, sort_keys=True, separators=(",", ":")) + "\n" for row in rows))
    with pytest.raises(InputError) as error:
        DecisionLog(log.folder).verify()
    assert says in error.value.expected
    with pytest.raises(InputError):
        DecisionLog(log.folder).append(ruling())


def test_a_signed_line_cannot_be_moved_within_the_chain(log):
    rows = made.lines(log.file)
    rows[2]["sequence"], rows[1]["sequence"] = 2, 3
    text = [json.dumps(rows[k], sort_keys=True, separators=(",", ":")) for k in (0, 2, 1)]
    log.file.write_text("".join(f"{line}\n" for line in text))
    with pytest.raises(InputError, match="cannot be read"):
        DecisionLog(log.folder).verify()


def test_a_log_that_became_shorter_while_it_was_open_is_refused(log):
    log.file.write_bytes(b"".join(log.file.read_bytes().splitlines(True)[:1]))
    with pytest.raises(InputError, match="cannot be read"):
        log.read()


@pytest.mark.parametrize("keep", [1, 40])
def test_an_unfinished_line_is_refused_and_repaired(log, keep):
    whole = log.file.read_bytes()
    with log.file.open("ab") as file:
        file.write(whole.splitlines()[0][:keep])
    for read in (DecisionLog(log.folder).read, lambda: log.append(ruling("c3"))):
        with pytest.raises(InputError, match="is not finished") as error:
            read()
        assert "gnmreg gate verify --repair" in error.value.fix and "line 4" in error.value.where
    aside = log.repair()
    assert aside is not None and len(aside.read_bytes()) == keep and log.file.read_bytes() == whole
    assert log.repair() is None
    assert log.append(ruling("c3")).sequence == 4 and log.verify().sequence == 4


def test_another_key_is_refused(log, tmp_path):
    other = DecisionLog.of_farm(tmp_path / "other")
    other.append(ruling())
    (log.folder / "key.pub").write_bytes((other.folder / "key.pub").read_bytes())
    with pytest.raises(InputError, match="cannot be read") as error:
        DecisionLog(log.folder).read()
    assert "signature" in error.value.expected


def test_a_lost_or_open_or_foreign_key_is_refused(log):
    key = log.folder / "key"
    key.chmod(0o640)
    with pytest.raises(InputError, match="key of the gate's decisions"):
        log.append(ruling())
    key.chmod(0o600)
    content = key.read_bytes()
    key.write_bytes(b"-----BEGIN PRIVATE KEY-----\n")
    with pytest.raises(InputError, match="key of the gate's decisions"):
        log.append(ruling())
    key.unlink()  # a new one would sign a log whose entries it did not sign
    with pytest.raises(InputError, match="key of the gate's decisions"):
        log.append(ruling())
    key.write_bytes(content)
    key.chmod(0o600)
    assert log.append(ruling()).sequence == 4


@pytest.mark.parametrize("fields", [{"content_id": ""}, {"who": " "}, {"reason": "x" * 2001}, {"name": "n" * 1001}])
def test_decisions_of_odd_lengths_are_refused(tmp_path, fields):
    log = DecisionLog.of_farm(tmp_path)
    with pytest.raises(InputError, match="cannot be recorded"):
        log.append(ruling(**fields))
    assert not log.exists()


def test_a_reason_may_hold_anything(tmp_path):
    log = DecisionLog.of_farm(tmp_path)
    text = "line\nbreak \x1b[31m <b>ü\u2028</b> \\ \" 'quoted'"
    assert log.append(ruling(reason=text)).reason == text
    assert DecisionLog.of_farm(tmp_path).read()[0].reason == text and len(log.file.read_text().splitlines()) == 1


WRITER = """
import sys
from pathlib import Path
from workflows.gate.decisions import DecisionLog
from tests.workflows.gate.test_decisions import ruling

log = DecisionLog.of_farm(Path(sys.argv[1]))
for number in range(20):
    log.append(ruling(f"{sys.argv[2]}-{number}"))
"""


def test_processes_and_threads_append_at_the_same_time(tmp_path):
    command = [sys.executable, "-c", WRITER, str(tmp_path)]
    others = [subprocess.Popen([*command, name], cwd=ROOT) for name in ("x", "y")]
    shared = DecisionLog.of_farm(tmp_path)

    def append(number: int) -> int:
        log = shared if number % 2 else DecisionLog.of_farm(tmp_path)
        return log.append(ruling(f"z-{number}")).sequence

    with ThreadPoolExecutor(4) as threads:
        numbers = list(threads.map(append, range(20)))
    assert [process.wait() for process in others] == [0, 0]
    assert len(set(numbers)) == 20
    entries = DecisionLog.of_farm(tmp_path).read()
    assert len(entries) == 60 and len({entry.content_id for entry in entries}) == 60


def test_the_command_refuses_a_folder_without_decisions(tmp_path, capsys):
    assert main(["gate", "verify", "--folder", str(tmp_path)]) == 2
    assert "There is no log of decisions" in capsys.readouterr().err and not list(tmp_path.iterdir())
