"""Which queue a command uses: --db, then a queue in --folder, then GNMREG_DB."""

from pathlib import Path

import pytest

from registration.errors import InputError
from workflows.cli.options import FarmOptions, RunOptions
from workflows.engine.database import FILE, default_url

OTHER = "sqlite:////tmp/other/queue.sqlite"


@pytest.fixture
def own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with a queue, while the environment names another one."""
    monkeypatch.setenv("GNMREG_DB", OTHER)
    folder = tmp_path / "farm"
    folder.mkdir()
    (folder / FILE).touch()
    return folder


def test_a_queue_in_the_folder_beats_the_environment(own: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert FarmOptions(folder=own).url == default_url(own)
    assert "GNMREG_DB is not used" in capsys.readouterr().err
    assert RunOptions(folder=own).url_for(own) == default_url(own)


def test_the_environment_counts_for_a_folder_of_logs(own: Path, tmp_path: Path) -> None:
    """Several machines share the database of the environment, and a folder for their logs."""
    assert FarmOptions(folder=tmp_path).url == OTHER
    assert FarmOptions().url == OTHER
    assert RunOptions(folder=tmp_path).url_for(tmp_path) == OTHER


def test_a_farm_on_this_machine_has_a_queue_of_its_own(own: Path, tmp_path: Path) -> None:
    options = RunOptions(local=True)
    assert options.url_for(options.farm_folder(tmp_path / "out")) == default_url(tmp_path / "out.farm")


def test_an_explicit_database_beats_all(own: Path) -> None:
    url = "sqlite:////tmp/third/queue.sqlite"
    assert FarmOptions(folder=own, db=url).url == url
    assert RunOptions(local=True, db=url).url_for(own) == url
    assert FarmOptions(folder=own, db="GNMREG_DB").url == OTHER


def test_the_environment_must_be_set_to_be_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("GNMREG_DB", raising=False)
    with pytest.raises(InputError, match="names no queue"):
        assert FarmOptions(db="GNMREG_DB").url
