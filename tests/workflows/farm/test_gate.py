"""`gnmreg coregister --gate person` on a real queue: parked, decided and retried by commands, in two rounds."""

import json
import shutil
from pathlib import Path

import pytest

from tests.workflows.farm.harness import TRUE_ROUNDS, Farm, open_farm
from tests.workflows.rounds import MODEL, write_people
from workflows.cli.app import main

NAMES = ("p0/neutral", "p0/smile", "p1/neutral", "p1/smile")


def parked(farm: Farm) -> str:
    """Wait until the run has ended, and return why it is parked."""
    farm.wait_for_end("june")
    job = farm.job("june")
    assert job["state"] == "failed" and job["failure"]["status"] == "parked", job
    return str(job["failure"]["reason"])


@pytest.mark.slow
def test_each_round_waits_for_a_person(capture: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    dataset, out, first = write_people(capture, tmp_path / "dataset", 4), tmp_path / "june", tmp_path / "first"
    first.mkdir()
    for file in (MODEL, MODEL.with_name("head_sparse_68.txt")):
        shutil.copy(file, first)
    folder = ["--folder", str(tmp_path)]

    def gnmreg(*words: str) -> str:
        assert main([*words, *folder]) == 0, capsys.readouterr()
        return capsys.readouterr().out

    last = ("accept", "reject")  # after a rejection the stopping rule finds too many failures
    with open_farm(tmp_path, work=TRUE_ROUNDS) as farm:
        farm.start("w0", "c0")
        command = ["coregister", str(dataset), "--model", str(first / MODEL.name), "--out", str(out)]
        rounds = ["--iterations", "2", "--all-iterations", "--anatomy", "keep", "--components", "2"]
        assert "june is in the queue" in gnmreg(*command, *rounds, "--gate", "person")
        for number in range(2):
            assert "4 registrations wait for a person" in parked(farm)
            listed = gnmreg("gate", "verdicts", "june", "--policy", "person")
            assert "4 registrations: 0 accept, 4 look, 0 reject; 0 may be used, 4 wait" in listed
            for name in NAMES[:-1]:
                gnmreg("gate", "decide", "june", name, "accept", "--who", "eve")
            gnmreg("retry", "june")
            assert "1 registration waits for a person" in parked(farm)
            assert not (out / f"it0{number}" / "model").exists()
            gnmreg("gate", "decide", "june", NAMES[-1], last[number], "--who", "eve", "--reason", "blurred")
            gnmreg("retry", "june")
        farm.wait_for_end("june")
        assert farm.job("june")["state"] == "done", farm.job("june")
    for number in range(2):
        gate = json.loads((out / f"it0{number}/model/gnm_head.manifest.json").read_text())["gate"]
        assert gate["accepted"] == 4 - number and gate["waiting"] == 0
        assert gate["left_out"] == ({NAMES[-1]: "eve: blurred"} if number else {})
        assert [entry["sequence"] for entry in gate["decisions"]] == [4 * number + k for k in (1, 2, 3, 4)]
