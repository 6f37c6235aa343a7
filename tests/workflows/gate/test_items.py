"""Registrations of runs at the gate, the commands, and the gate's own error."""

import csv
import hashlib
import json
import os
from dataclasses import replace
from itertools import count
from pathlib import Path
from types import SimpleNamespace

import pytest
from scipy.stats import beta

import workflows.gate.items
from registration.errors import InputError
from tests.workflows.gate import made
from tests.workflows.gate.test_decisions import ruling
from workflows.cli.app import main
from workflows.engine.reader import JobRow
from workflows.gate.decisions import DecisionLog, current
from workflows.gate.item import gate_error, of_last_round
from workflows.gate.items import find_registrations, gate_items
from workflows.gate.rules import GateThresholds
from workflows.gate.table import accepted_id, to_csv
from workflows.records.store import Store

QUIET = GateThresholds(sample_share=0.0)


@pytest.fixture
def run(tmp_path: Path) -> Path:
    """Two subjects: a good neutral, one to look at, one to reject; a good neutral."""
    run = tmp_path / "run"
    captures = {
        "neutral": made.figures(),
        "smile": made.figures(normals_deg=7.0),
        "jaw": made.figures(normals_deg=70.0),
    }
    made.write_subject(run / "ann", 1, captures)
    made.write_subject(run / "bob", 2, {"neutral": made.figures()})
    return run


def items(run: Path, farm: Path | None = None):
    decisions = current(DecisionLog.of_farm(farm).read()) if farm else {}
    return gate_items(find_registrations(str(run)), QUIET, decisions)


def test_a_folder_of_subjects(run):
    found = items(run)
    assert [(item.name, item.verdict.level) for item in found] == [
        ("ann/neutral", "accept"),
        ("ann/smile", "look"),
        ("ann/jaw", "reject"),
        ("bob/neutral", "accept"),
    ]
    assert [item.accepted("auto") for item in found] == [True, True, False, True]
    assert [item.accepted("person") for item in found] == [True, False, False, True]
    assert [item.waits for item in found] == [False, True, False, False]
    assert [item.name for item in items(run / "bob")] == ["bob/neutral"]
    (run / "bob" / "subject.json").unlink()
    assert [item.name for item in items(run)][-1] == "bob/neutral"  # registrations without a subject's record
    assert [item.name for item in items(run / "bob" / "neutral")] == ["neutral"]


def test_of_a_coregistration_the_last_round_counts(run, tmp_path):
    out = tmp_path / "out"
    for number in range(2):
        (out / f"it0{number}").mkdir(parents=True)
    (out / "plan.json").write_text("{}")
    os.replace(run, out / "it01" / "registrations")
    assert len(items(out)) == 4
    os.replace(out / "it01" / "registrations", out / "it00" / "registrations")
    with pytest.raises(InputError, match="There are no registrations"):
        items(out)


def test_a_store(tmp_path):
    store = Store(tmp_path / "store")

    def publish(key: str, **values: object) -> None:
        store.produce(
            key, input_hash="h", make=lambda folder: {} if made.write(folder / "registration", **values) else {}
        )

    publish("ann/smile", **made.figures())
    publish("ann/jaw", **made.figures(normals_deg=70.0))
    store.produce("other", input_hash="h", make=lambda folder: {"size": (folder / "x").write_text("x")})
    found = items(tmp_path / "store")
    assert {item.name: item.verdict.level for item in found} == {"ann/smile": "accept", "ann/jaw": "reject"}
    assert all((Path(item.place) / "registration.npz").is_file() for item in found)
    manifest = next(Path(found[0].place).glob("manifest.json"))
    manifest.write_text(manifest.read_text().replace("converged", "failed   "))
    with pytest.raises(InputError, match="artifact cannot be read"):
        items(tmp_path / "store")


@pytest.mark.parametrize("name", ["nothing", "empty", "file"])
def test_what_is_no_run_is_refused(tmp_path, name):
    (tmp_path / "empty").mkdir()
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="There are no registrations"):
        find_registrations(str(tmp_path / name))


def test_a_persons_decision_beats_the_verdict(run, tmp_path):
    log = DecisionLog.of_farm(tmp_path)
    before = {item.name: item for item in items(run)}
    for name, decision in (("ann/jaw", "accept"), ("ann/smile", "reject"), ("bob/neutral", "reject")):
        log.append(ruling(before[name].content_id, decision))
    after = {item.name: item for item in items(run, tmp_path)}
    assert {name: item.accepted("auto") for name, item in after.items()} == {
        "ann/neutral": True,
        "ann/smile": False,
        "ann/jaw": True,
        "bob/neutral": False,
    }
    assert not any(item.waits for item in after.values())
    log.append(ruling(before["ann/smile"].content_id, "undo"))
    assert {item.name for item in items(run, tmp_path) if item.waits} == {"ann/smile"}


def test_the_gates_own_error_comes_from_the_sample(run, tmp_path):
    log, everyone = DecisionLog.of_farm(tmp_path), replace(QUIET, sample_share=1.0)
    found = gate_items(find_registrations(str(run)), everyone, {})
    assert gate_error(found) is None
    assert [item.waits for item in found] == [True, True, False, True]
    for item in found:
        log.append(ruling(item.content_id, "reject" if item.name == "ann/neutral" else "accept"))
    error = gate_error(gate_items(find_registrations(str(run)), everyone, current(log.read())))
    assert error is not None and (error.shown, error.rejected, error.share) == (2, 1, 0.5)  # two are accepted
    assert 0.01 < error.low < 0.02 and 0.98 < error.high < 0.99  # of the exact interval of 1 in 2
    assert gate_error(gate_items(find_registrations(str(run)), QUIET, current(log.read()))) is None


@pytest.mark.parametrize(("rejected", "shown"), [(0, 1), (1, 1), (0, 40), (3, 40), (39, 40), (500, 1000), (2, 50_000)])
def test_the_interval_of_the_error_is_exact(rejected, shown):
    """Clopper and Pearson's, as the beta distribution gives it."""
    entry = SimpleNamespace(decision="reject"), SimpleNamespace(decision="accept")
    shown_one = [SimpleNamespace(verdict=SimpleNamespace(sampled=True), decision=one) for one in entry]
    error = gate_error([shown_one[0]] * rejected + [shown_one[1]] * (shown - rejected))
    low = beta.ppf(0.025, rejected, shown - rejected + 1) if rejected else 0.0
    high = beta.ppf(0.975, rejected + 1, shown - rejected) if rejected < shown else 1.0
    assert (error.low, error.high) == pytest.approx((low, high), abs=1e-9)


def test_the_table_holds_no_formula_and_the_set_has_one_id(run):
    found = items(run)
    rows = list(csv.DictReader(to_csv([replace(found[1], name="=cmd()")], "auto").splitlines()))
    assert rows[0]["name"] == "'=cmd()" and rows[0]["verdict"] == "look" and rows[0]["normals_deg"] == "7"
    assert rows[0]["scan_mm"] == "" and "scan_mm" in rows[0]["unmeasured"] and rows[0]["accepted"] == "yes"
    assert accepted_id(found, "auto") == accepted_id(found[::-1], "auto") != accepted_id(found, "person")


def test_verdicts_decisions_and_replay_on_the_command_line(run, tmp_path, capsys):
    farm = ["--folder", str(tmp_path / "farm")]
    assert main(["gate", "verdicts", str(run), "--out", str(tmp_path / "table.csv"), *farm]) == 0
    shown = capsys.readouterr().out
    assert (
        "look    ann/smile  normals 7.0° (limit 5.0°)" in shown
        and "4 registrations: 2 accept, 1 look, 1 reject" in shown
    )
    assert len((tmp_path / "table.csv").read_text().splitlines()) == 5
    decide = ["gate", "decide", str(run)]
    assert main([*decide, "ann/smile", "reject", "--reason", "eyes closed", "--who", "eve", *farm]) == 0
    assert main([*decide, items(run)[2].content_id[:10], "accept", *farm]) == 0
    capsys.readouterr()
    assert main([*decide, "ann/smil", "accept", *farm]) == 2
    assert "ann/smile" in capsys.readouterr().err
    assert main(["gate", "verify", *farm]) == 0
    head = capsys.readouterr().out.split()[-1]
    entries = DecisionLog.of_farm(tmp_path / "farm").read()
    assert (entries[0].who, entries[0].verdict, entries[0].reason) == ("eve", "look", "eyes closed")
    assert head == hashlib.sha256(entries[-1].line()).hexdigest()
    assert main(["gate", "replay", str(run), *farm]) == 0
    first = capsys.readouterr().out
    assert "3 of 4 accepted" in first and "ann/smile" not in first and "ann/jaw" in first
    copy = tmp_path / "copy"
    copy.mkdir()
    for name in ("decisions.jsonl", "key.pub"):
        (copy / name).write_bytes((tmp_path / "farm" / "gate" / name).read_bytes())
    assert main(["gate", "replay", str(run), "--decisions", str(copy / "decisions.jsonl")]) == 0
    assert capsys.readouterr().out == first
    assert main([*decide, "ann/smile", "undo", *farm]) == 0
    assert main(["gate", "verify", "--head", head, *farm]) == 0
    log = tmp_path / "farm" / "gate" / "decisions.jsonl"
    log.write_bytes(log.read_bytes().splitlines(True)[0])
    capsys.readouterr()
    assert main(["gate", "verify", "--head", head, *farm]) == 2
    assert "lacks entries" in capsys.readouterr().err
    log.write_bytes(log.read_bytes()[:-5])
    assert main(["gate", "verify", *farm]) == 2 and "is not finished" in capsys.readouterr().err
    assert main(["gate", "verify", "--repair", *farm]) == 0


def test_thresholds_are_taken_from_a_file(run, tmp_path, capsys):
    thresholds = json.loads(GateThresholds(sample_share=0.0).to_text())
    thresholds["normals_deg"] = {"look": 8.0, "reject": None}
    (tmp_path / "t.json").write_text(json.dumps(thresholds))
    assert main(["gate", "verdicts", str(run), "--thresholds", str(tmp_path / "t.json"), "--policy", "person"]) == 0
    assert "3 accept, 1 look, 0 reject; 3 may be used, 1 wait for a person" in capsys.readouterr().out
    assert main(["gate", "verdicts"]) == 2
    farm = tmp_path / "farm"
    (farm / "gate").mkdir(parents=True)
    (tmp_path / "t.json").rename(farm / "gate" / "thresholds.json")  # the farm's own
    capsys.readouterr()
    assert main(["gate", "verdicts", str(run), "--folder", str(farm)]) == 0
    assert "3 accept, 1 look, 0 reject" in capsys.readouterr().out


def test_a_run_of_the_queue_is_found_by_its_name(run, tmp_path, monkeypatch):
    """Of a batch what its jobs published, of a coregistration what they wrote; jobs that are not done are left out."""
    store = Store(tmp_path / "store")

    def make(folder: Path) -> dict[str, str]:
        made.write(folder / "registration", **made.figures())
        return {}

    for key in ("cyd/smile", "cyd/jaw"):
        store.produce(key, input_hash="h", make=make)
    shared = {"kind": "job", "executor": None, "result": None, "failure": None, "created": 0.0, "ended": None}

    ids = count()

    def job(state: str, **arguments: str) -> JobRow:
        return JobRow(id=f"night/{next(ids)}", state=state, spec={"step": "s", "arguments": arguments}, **shared)

    rows = [
        job("done", capture="/c", store=store.url, key="cyd/smile"),
        job("waiting", capture="/c", store=store.url, key="cyd/jaw"),
        job("failed", capture="/c", store=store.url, key="cyd/none"),
        job("done", capture="/c", out=str(run / "ann" / "smile")),
        job("done", capture="/c", out=str(run / "ann" / "none")),
        job("done", run=str(run), out=str(tmp_path)),
    ]

    class Reader:
        def __init__(self, url: str) -> None:
            assert url == "sqlite:///q"

        def listing(self, name: str) -> list[JobRow]:
            return rows if name == "night" else []

    monkeypatch.setattr(workflows.gate.items, "QueueReader", Reader)
    found = find_registrations("night", "sqlite:///q")
    assert [one.name for one in found] == ["cyd/smile", "ann/smile"]
    with pytest.raises(InputError, match="There are no registrations"):
        find_registrations("day", "sqlite:///q")
    with pytest.raises(InputError, match="cannot be used"):
        find_registrations("../night", "sqlite:///q")


def test_of_a_coregistration_the_last_round_is_at_the_gate():
    rounds = [f"week/{part}/s00000-ann/{name}" for part in ("held", "it02", "it00", "it10") for name in ("a", "b")]
    assert of_last_round(rounds) == rounds[-2:]
    assert of_last_round(rounds[:2]) == rounds[:2]  # nothing but the held-out subjects yet
    assert of_last_round(["night/it00/smile", *rounds]) == ["night/it00/smile", *rounds]
    assert of_last_round([]) == []
