"""The client, `--server`, and the commands of docs/service.md against a real service."""

import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from registration.errors import InputError
from tests.conftest import FIXTURES, ROOT
from tests.workflows.conftest import add
from tests.workflows.service.conftest import RunningService
from tests.workflows.service.document import blocks
from workflows.cli.app import main
from workflows.service.client import ServiceClient, ServiceRefusal, read_token


@pytest.fixture(scope="module")
def model(service) -> str:
    folder = service.folder / "models" / "first"
    folder.mkdir()
    for name in ("tiny_gnm.npz", "head_sparse_68.txt"):
        shutil.copyfile(FIXTURES / name, folder / name)
    return "first"


@pytest.fixture
def laptop(capture, tmp_path, monkeypatch) -> Path:
    """A folder with the captures of two subjects, from which commands are called."""
    for subject in ("ann", "tom"):
        add(capture, tmp_path / subject / "smile", "smile", subject)
        add(capture, tmp_path / subject / "rest", "neutral", subject)
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.skipif(shutil.which("curl") is None, reason="no curl")
def test_the_commands_of_the_document(service: RunningService, model, laptop):
    commands = "\n".join(blocks(section) for section in ("Upload", "Submit", "Client"))
    assert commands.count("curl") == 4 and commands.count("gnmreg") == 5
    script = f'set -e\ngnmreg() {{ PYTHONPATH={ROOT} {sys.executable} -m workflows.cli "$@"; }}\n{commands}'
    environment = {"SERVER": service.url, "GNMREG_TOKEN": service.tokens["operator"], "PATH": "/usr/bin:/bin"}
    done = subprocess.run(["bash", "-c", script], cwd=laptop, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "ann/smile: is there already" in done.stdout and "ann/rest: uploaded" in done.stdout
    assert "tuesday: batch: 2 waiting" in done.stdout and "requeued" in done.stdout
    assert service.get("/runs/monday").json["counts"] == {"waiting": 1}


def test_a_batch_from_a_laptop(service: RunningService, model, laptop, monkeypatch, capsys):
    monkeypatch.setenv("GNMREG_TOKEN", service.tokens["operator"])
    to = ["--model", model, "--out", "wednesday", "--server", service.url]
    (laptop / "tom" / "broken").mkdir()
    (laptop / "tom" / "broken" / "capture.toml").write_text("kind = [")
    shutil.copytree(laptop / "tom" / "rest", service.folder / "captures" / "tom" / "seen")
    seen = service.folder / "captures" / "tom" / "seen"
    assert main(["batch", "tom/rest", "tom/broken", str(seen), "none/there", *to]) == 1
    printed = capsys.readouterr()
    assert "tom/rest: uploaded" in printed.out and "2 captures are in the queue" in printed.out
    assert "tom/broken" in printed.err and "none/there" in printed.err
    (laptop / "tom" / "rest" / "notes.txt").write_text("changed")
    assert main(["batch", "tom/rest", *to]) == 2
    assert "exists" in capsys.readouterr().err
    assert main(["batch", "tom/rest", *to, "--replace"]) == 2  # a job waits that reads it
    assert "cancel wednesday/tom/rest first" in capsys.readouterr().err
    assert main(["cancel", "wednesday", "--server", service.url]) == 0
    assert main(["batch", "tom/rest", *to, "--replace"]) == 0
    assert main(["status", "--run", "wednesday", "--jobs", "--server", service.url]) == 0
    assert "wednesday/tom/rest  waiting" in capsys.readouterr().out


def test_a_coregistration_from_a_laptop(service: RunningService, model, monkeypatch, capsys):
    monkeypatch.setenv("GNMREG_TOKEN", service.tokens["operator"])
    words = ["coregister", "nowhere", "--model", model, "--out", "rounds7", "--server", service.url]
    assert main(words) == 2
    assert "outside those of the service" in capsys.readouterr().err
    assert main([*words, "--gate-thresholds", "mine.json"]) == 2
    assert "Thresholds of the gate cannot be sent" in capsys.readouterr().err


def test_refusals_have_all_parts(service: RunningService, monkeypatch, capsys):
    viewer = ServiceClient(service.url, service.tokens["viewer"])
    with pytest.raises(ServiceRefusal) as refusal:
        viewer.post("/cancel", {"run": "none"})
    assert refusal.value.status == 403 and refusal.value.expected == "operator" and "token" in refusal.value.fix
    monkeypatch.setenv("GNMREG_TOKEN", "gnmreg_00000000_wrong")
    assert main(["status", "--server", service.url]) == 2
    assert "The token is not valid" in capsys.readouterr().err


@pytest.mark.parametrize("url", ["", "127.0.0.1:1", "file:///etc/passwd", "http://", "http://a:b@127.0.0.1:1"])
def test_urls_that_are_none(url):
    with pytest.raises(InputError, match="The service cannot be used"):
        ServiceClient(url, "token")


def test_a_place_where_nothing_answers():
    with pytest.raises(InputError, match="The service cannot be used"):
        ServiceClient("http://127.0.0.1:1", "token").get("/runs")


def test_the_token_comes_from_a_file_or_the_environment(tmp_path, monkeypatch):
    monkeypatch.delenv("GNMREG_TOKEN", raising=False)
    (tmp_path / "token").write_text("abc\n")
    assert read_token(tmp_path / "token") == "abc"
    (tmp_path / "token").write_text("a\nb")
    for file in (None, tmp_path / "token", tmp_path / "none"):
        with pytest.raises(InputError, match="token"):
            read_token(file)
    monkeypatch.setenv("GNMREG_TOKEN", "xyz")
    assert read_token(None) == "xyz"


def test_the_client_imports_no_framework():
    listed = "[name for name in ('fastapi', 'starlette', 'torch') if name in sys.modules]"
    code = f"import sys, workflows.service.client; print({listed})"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=ROOT)
    assert done.stdout == "[]\n"
