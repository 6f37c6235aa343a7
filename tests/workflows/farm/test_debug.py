"""Repeating a job in the foreground, with stand-ins for registrations."""

import urllib.request
from pathlib import Path
from typing import Any

import pytest

from registration import pipeline
from registration.errors import InputError
from registration.options import RegisterOptions
from registration.progress import NullProgress
from tests.registration.capture import small
from tests.registration.register import synthetic
from tests.registration.report.test_page import a_registration
from workflows.engine.reader import JobRow
from workflows.farm.debug import debug


def row(step: str = "register", kind: str = "job", **arguments: Any) -> JobRow:
    return JobRow(
        id="run/s1/e001",
        kind=kind,
        state="failed",
        executor="w",
        spec={"step": step, "arguments": arguments},
        result=None,
        failure=None,
        created=0.0,
        ended=None,
    )


@pytest.fixture
def calls(monkeypatch: pytest.MonkeyPatch) -> list[dict[str, Any]]:
    recorded: list[dict[str, Any]] = []

    def register(capture: Path, model: Path, out: Path, options: RegisterOptions, **settings: Any) -> Any:
        recorded.append({"capture": capture, "model": model, "out": out, "options": options, **settings})
        return a_registration(status="failed", reason="did not converge")

    monkeypatch.setattr(pipeline, "register", register)
    return recorded


@pytest.mark.parametrize("step", ["register", "register stored"])
def test_a_registration_is_repeated_with_stage_images_in_another_folder(
    calls: list[dict[str, Any]], tmp_path: Path, step: str
) -> None:
    arguments = {"capture": "/c/e", "model": "/m.npz", "options": {"recipe": "studio", "views": 5, "seed": 3}}
    locations = {
        "register": {"out": "/results/e", "neutral": "/results/n"},
        "register stored": {"store": "/s", "key": "k"},
    }
    result = debug(row(step, **arguments, **locations[step]), tmp_path / "out", NullProgress())
    assert result.summary == "failed: did not converge" and result.page is None
    (call,) = calls
    assert call["capture"] == Path("/c/e") and call["model"] == Path("/m.npz")
    assert call["out"] == tmp_path / "out" / "registration" and call["pictures"] == tmp_path / "out" / "stages"
    assert call["neutral"] == (Path("/results/n") if step == "register" else None)
    assert call["options"] == RegisterOptions(recipe="studio", views=5, seed=3)


def test_a_capture_from_a_url_is_kept_for_inspection(
    calls: list[dict[str, Any]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("workflows.farm.debug.fetch_folder", lambda url, folder: folder.mkdir(parents=True))
    monkeypatch.setattr("workflows.farm.debug.fetch_model", lambda url: Path("/cache/m.npz"))
    stored = row("register stored", capture="s3://b/c/e", model="s3://b/m.npz", store="s3://b/s", key="k")
    debug(stored, tmp_path / "out", NullProgress())
    assert calls[0]["capture"] == tmp_path / "out" / "inputs" / "e" and calls[0]["capture"].is_dir()


def test_a_registration_can_be_watched(calls: list[dict[str, Any]], tmp_path: Path) -> None:
    capture = small.make(tmp_path / "capture")
    done = debug(row(capture=str(capture), model=str(synthetic.MODEL)), tmp_path / "out", NullProgress(), port=0)
    assert done.page is not None
    with urllib.request.urlopen(done.page.url, timeout=10) as answer:
        assert answer.status == 200
    done.page.close()


def test_the_page_is_closed_when_the_registration_is_refused(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    def refuse(*_: Any, **__: Any) -> None:
        raise InputError("no", where="here", expected="a", got="b", fix="c")

    ports: list[int] = []
    monkeypatch.setattr(pipeline, "register", refuse)
    monkeypatch.setattr(NullProgress, "message", lambda self, text: ports.append(int(text.split(":")[2].split("/")[0])))
    capture = small.make(tmp_path / "capture")
    with pytest.raises(InputError, match="no"):
        debug(row(capture=str(capture), model=str(synthetic.MODEL)), tmp_path / "out", NullProgress(), port=0)
    with pytest.raises(OSError):
        urllib.request.urlopen(f"http://127.0.0.1:{ports[0]}", timeout=10)


def test_jobs_that_cannot_be_debugged_are_refused(calls: list[dict[str, Any]], tmp_path: Path) -> None:
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "x").write_text("mine")
    for bad_row, out in (
        (row(kind="flow"), tmp_path / "out"),
        (row(), tmp_path / "full"),
        (row(step="os:system"), tmp_path / "out"),
        (row(capture="http://x/y"), tmp_path / "out"),
    ):
        with pytest.raises(InputError):
            debug(bad_row, out, NullProgress())
    with pytest.raises(InputError, match="--view cannot show"):
        debug(row(step="stabilize", run="/r", model="/m.npz", out="/o"), tmp_path / "out", NullProgress(), port=0)
    with pytest.raises(InputError, match="cannot be debugged"):  # it would write into the coregistration's folder
        debug(row(step="end round", plan="/p/plan.json", held_out={}, rounds=[]), tmp_path / "out", NullProgress())
    assert not calls and not (tmp_path / "out").exists()
