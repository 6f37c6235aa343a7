"""Process pools: cores per worker, and termination with the parent."""

import os
import signal
import subprocess
import sys
import time

import pytest

from tests.workflows.farm.harness import ROOT, alive, interruptible
from workflows.processes import run_parallel, shared_cores, terminated_with_us


def test_workers_are_reused_and_share_the_cores(monkeypatch):
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    monkeypatch.setattr(os, "cpu_count", lambda: 8)
    for jobs, threads in ((4, "2"), (1, None)):
        with shared_cores(jobs), terminated_with_us(jobs) as pool:
            assert pool.schedule(os.getenv, ("OMP_NUM_THREADS",)).result() == threads
    assert "OMP_NUM_THREADS" not in os.environ
    monkeypatch.setenv("OMP_NUM_THREADS", "3")
    with shared_cores(4), terminated_with_us(1) as pool:
        assert pool.schedule(os.getenv, ("OMP_NUM_THREADS",)).result() == "3"
        assert len({pool.schedule(os.getpid).result() for _ in range(3)}) == 1


def test_a_dead_worker_does_not_stop_the_others():
    calls = {"ann": {"key": "NO_SUCH", "default": ""}, "bob": {"key": "NO_SUCH", "default": "tired"}}
    assert dict(run_parallel(os.getenv, calls, jobs=2)) == {"ann": "", "bob": "tired"}
    assert dict(run_parallel(os._exit, {"cleo": {"status": 3}}, jobs=1)) == {"cleo": "its process died"}


SLEEPER = """
import os, time
from workflows.processes import terminated_with_us
if __name__ == "__main__":
    with terminated_with_us(1) as pool:
        print(pool.schedule(os.getpid).result(), flush=True)
        pool.schedule(time.sleep, (600,)).result()
"""


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGINT])
def test_workers_end_with_a_killed_or_interrupted_parent(tmp_path, number):
    (tmp_path / "sleeper.py").write_text(SLEEPER)
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    command = [sys.executable, str(tmp_path / "sleeper.py")]
    parent = subprocess.Popen(
        command,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
        env=environment,
        preexec_fn=interruptible,
    )
    assert parent.stdout is not None
    child = int(parent.stdout.readline())
    time.sleep(0.5)
    parent.send_signal(number)
    parent.wait(timeout=30)
    for _ in range(100):
        if not alive(child):
            return
        time.sleep(0.1)
    raise AssertionError("the child still runs")


def _interrupt_itself() -> str:
    os.kill(os.getpid(), signal.SIGINT)
    return "went on"


def test_ctrl_c_is_the_parents_to_handle() -> None:
    """A terminal sends it to all processes of a command: children would print tracebacks."""
    with terminated_with_us(1) as pool:
        assert pool.schedule(_interrupt_itself).result(timeout=60) == "went on"
    assert signal.SIGINT not in signal.pthread_sigmask(signal.SIG_BLOCK, ())
