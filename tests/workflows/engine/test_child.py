import asyncio
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.workflows.farm.harness import ROOT, alive, children_of
from workflows.engine.child import StepProcess

STEPS = "tests.workflows.farm.steps"


@pytest.fixture(scope="module")
def process() -> Iterator[StepProcess]:
    process = StepProcess(modules=(STEPS,))
    process.warm()
    yield process
    process.kill()


def run(process: StepProcess, name: str, log: Path, timeout_s: float = 30.0, **arguments: object) -> dict:
    return asyncio.run(process.run(f"{STEPS}:{name}", arguments, log=log, timeout_s=timeout_s))


def test_the_output_of_a_step_is_written_to_its_log(process: StepProcess, tmp_path: Path) -> None:
    log = tmp_path / "a" / "job.log"
    outcome = run(process, "talk", log, text="from a note")
    assert (outcome["status"], outcome["result"]) == ("done", "from a note")
    text = log.read_text()
    assert set(text.split("\n")) >= {"from Python", "from C"} and re.search(r"^\d\d:\d\d:\d\d from a note$", text, re.M)
    assert '"done": 1' in log.with_suffix(".jsonl").read_text()


def test_the_log_says_when_each_attempt_began_and_how_it_ended(process: StepProcess, tmp_path: Path) -> None:
    log = tmp_path / "job.log"
    for title, step in (
        ("attempt 1 of 3 on w0", "fail"),
        ("attempt 2 of 3 on w1", "crash"),
        ("attempt 3 of 3", "talk"),
    ):
        arguments = {"text": "hello"} if step == "talk" else {}
        asyncio.run(process.run(f"{STEPS}:{step}", arguments, log=log, timeout_s=60.0, title=title))
    lines = [line.split(" ", 3) for line in log.read_text().splitlines() if line.startswith("--- ")]
    assert all(re.fullmatch(r"\d{4}-\d\d-\d\d \d\d:\d\d:\d\d", f"{day} {clock}") for _, day, clock, _ in lines)
    said = [re.sub(r"[\d.]+ s,", "T,", text) for _, _, _, text in lines]
    assert said == [
        "attempt 1 of 3 on w0 begins",
        "attempt 1 of 3 on w0 ends after T, failed",
        "attempt 2 of 3 on w1 begins",
        "attempt 2 of 3 on w1 ends after T, died: its process was killed by SIGSEGV",
        "attempt 3 of 3 begins",
        "attempt 3 of 3 ends after T, done",
    ]


def test_one_warm_process_serves_all_steps(process: StepProcess, tmp_path: Path) -> None:
    before = process.warm()
    run(process, "talk", tmp_path / "log", text="")
    run(process, "fail", tmp_path / "log")
    assert process.warm() == before


@pytest.mark.parametrize(
    "name, arguments, status, reason",
    [
        ("refuse", {}, "bad input", "It is bad: here; expected good, got bad; mend it"),
        ("fail", {}, "failed", "ValueError: as asked, at postgresql://me:***@host/db"),
        ("leave", {}, "failed", "SystemExit: 0"),
        ("return_an_object", {}, "failed", "the step's result is not JSON"),
        ("return_much", {}, "failed", "more than 524288"),
        ("talk", {"word": 1}, "bad input", "cannot be called with these arguments"),
        ("nothing", {}, "bad input", "cannot be called with these arguments"),
        ("crash", {}, "died", "was killed by SIGSEGV"),
    ],
)
def test_each_failure_has_its_own_status_and_reason(
    process: StepProcess, tmp_path: Path, name: str, arguments: dict, status: str, reason: str
) -> None:
    outcome = run(process, name, tmp_path / "log", **arguments)
    assert outcome["status"] == status
    assert reason in outcome["reason"]
    assert "secret" not in (tmp_path / "log").read_text() + outcome["reason"]


def test_a_step_that_holds_the_interpreter_lock_is_killed_at_its_timeout(process: StepProcess, tmp_path: Path) -> None:
    trace = tmp_path / "trace"
    pid = process.warm()
    start = time.monotonic()
    outcome = run(process, "hold_gil", tmp_path / "log", timeout_s=0.5, seconds=60, trace=str(trace))
    assert outcome["status"] == "timed out" and time.monotonic() - start < 30
    assert not alive(pid)
    assert trace.read_text() == "begin gil 0\n"
    assert "timed out" in (tmp_path / "log").read_text()


def test_cancelling_kills_the_child(process: StepProcess, tmp_path: Path) -> None:
    pid = process.warm()

    async def cancelled() -> None:
        arguments = {"store": str(tmp_path), "key": "k", "seconds": 60.0}
        task = asyncio.create_task(process.run(f"{STEPS}:work", arguments, log=tmp_path / "log", timeout_s=90))
        while not list(tmp_path.glob("k/attempt-*")):
            await asyncio.sleep(0.05)
        task.cancel()
        await asyncio.wait({task})

    asyncio.run(cancelled())
    deadline = time.monotonic() + 20
    while alive(pid) and time.monotonic() < deadline:
        time.sleep(0.05)
    assert not alive(pid)


def test_a_child_that_dies_between_jobs_is_replaced(process: StepProcess, tmp_path: Path) -> None:
    pid = process.warm()
    os.kill(pid, signal.SIGKILL)
    time.sleep(0.5)
    assert run(process, "talk", tmp_path / "log", text="again")["status"] == "done"
    assert process.warm() != pid


def test_a_child_that_has_just_died_is_replaced(process: StepProcess) -> None:
    """The pool may notice the death before or after the next call is put into it."""
    for delay_s in (0.0, 0.02, 0.04, 0.06, 0.08):
        pid = process.warm()
        os.kill(pid, signal.SIGKILL)
        time.sleep(delay_s)
        assert process.warm() != pid


def test_a_child_dies_with_its_parent(tmp_path: Path) -> None:
    code = """
import time
from workflows.engine.child import StepProcess
if __name__ == "__main__":
    process = StepProcess()
    print(process.warm(), flush=True)
    time.sleep(60)
"""
    script = tmp_path / "parent.py"
    script.write_text(code)
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    parent = subprocess.Popen([sys.executable, str(script)], stdout=subprocess.PIPE, env=environment, text=True)
    assert parent.stdout is not None
    child = int(parent.stdout.readline())
    assert child in children_of(parent.pid) and alive(child)
    parent.kill()
    parent.wait()
    deadline = time.monotonic() + 10
    while alive(child) and time.monotonic() < deadline:
        time.sleep(0.02)
    assert not alive(child)
