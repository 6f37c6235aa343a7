"""Calls in other processes: results, failures, deaths, and what is left when the caller goes."""

import os
import subprocess
import sys
import time
from pathlib import Path

from tests.workflows import acts
from tests.workflows.conftest import Notes
from workflows.children import Lost, in_children


def calls(tmp_path: Path, **acts: str) -> dict[str, dict]:
    return {
        name: {"what": what, "value": k, "place": str(tmp_path / name)} for k, (name, what) in enumerate(acts.items())
    }


def test_one_failure_or_death_does_not_stop_the_others(tmp_path):
    asked = calls(tmp_path, anna="work", ben="refuse", cleo="raise", dan="die", eve="die once", finn="work")
    progress = Notes()
    found = dict(in_children(acts.act, asked, jobs=2, progress=progress))
    assert list(found) != [] and {*found} == {*asked}
    assert [found[name][1] for name in ("anna", "eve", "finn")] == [0, 8, 10]
    assert found["ben"] == Lost(reason="The lens is dirty: cam3; expected a clean one, got dust; wipe it")
    assert found["cleo"] == Lost(reason="RuntimeError: out of luck")
    assert found["dan"] == Lost(reason="the process ended by itself, SIGKILL")
    assert os.getpid() not in {found[name][0] for name in ("anna", "eve", "finn")}
    assert "anna: asked to work" in progress.notes and "anna: acting" in progress.steps
    assert progress.notes.count("dan: asked to die") == 2
    assert any("Traceback" in note for note in progress.notes)


def test_a_child_is_warm_and_cores_are_split(tmp_path, monkeypatch):
    found = dict(in_children(acts.act, calls(tmp_path, a="work", b="work", c="work"), jobs=1))
    assert len({pid for pid, _ in found.values()}) == 1
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    monkeypatch.setattr(os, "cpu_count", lambda: 8)
    assert dict(in_children(acts.threads, {"a": {}}, jobs=4)) == {"a": "2"}
    assert dict(in_children(acts.threads, {"a": {}}, jobs=1)) == {"a": None}
    monkeypatch.setenv("OMP_NUM_THREADS", "3")
    assert dict(in_children(acts.threads, {"a": {}}, jobs=4)) == {"a": "3"}


SLEEPER = """
import os, sys, time
from workflows.children import in_children
def sleep(progress):
    print(os.getpid(), flush=True)
    time.sleep(600)
if __name__ == "__main__":
    list(in_children(sleep, {"a": {}}))
"""


def test_children_end_with_a_parent_that_is_killed(tmp_path):
    (tmp_path / "sleeper.py").write_text(SLEEPER)
    root = Path(__file__).parents[2]
    parent = subprocess.Popen(
        [sys.executable, str(tmp_path / "sleeper.py")],
        stdout=subprocess.PIPE,
        text=True,
        env={**os.environ, "PYTHONPATH": str(root)},
    )
    assert parent.stdout is not None
    child = int(parent.stdout.readline())
    parent.kill()
    parent.wait()
    for _ in range(100):
        if not Path(f"/proc/{child}").exists() or "Z" in Path(f"/proc/{child}/stat").read_text().split()[2]:
            return
        time.sleep(0.1)
    raise AssertionError("the child is still there")
