"""A full disk is named, with the file that did not fit, and nothing half-written is left."""

import errno
import os
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest

from registration.storage.files import DiskFull, atomic_directory, atomic_write_bytes, naming_full_disk
from workflows.records.store import Store

MUCH = b"x" * 2**20


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A disk of 256 kB."""
    disk = tmp_path / "disk"
    disk.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=256k", "tmpfs", str(disk)]
    if os.getuid() != 0 or subprocess.run(mount, capture_output=True).returncode:
        pytest.skip("no disk can be mounted here")
    yield disk
    subprocess.run(["umount", "-l", str(disk)], check=True)


def test_a_file_that_does_not_fit_is_named_with_its_disk(small_disk: Path) -> None:
    with pytest.raises(DiskFull) as full:
        atomic_write_bytes(small_disk / "result.bin", MUCH)
    assert full.value.errno == errno.ENOSPC and full.value.filename == str(small_disk / "result.bin")
    assert f"the disk mounted at {small_disk}, 0.0 of 0.0 GB free" in str(full.value)
    assert list(small_disk.iterdir()) == []


def test_a_folder_that_does_not_fit_is_named_once(small_disk: Path) -> None:
    with pytest.raises(DiskFull, match=f"mounted at {small_disk}, .*inner.bin") as full:
        with atomic_directory(small_disk / "new" / "out") as temporary:
            atomic_write_bytes(temporary / "inner.bin", MUCH)
    assert str(full.value).count("mounted") == 1
    assert not (small_disk / "new" / "out").exists()


def test_an_artifact_that_does_not_fit_is_named_with_its_disk(small_disk: Path) -> None:
    def make(folder: Path) -> dict:
        (folder / "much").write_bytes(MUCH)
        return {}

    with pytest.raises(DiskFull, match=f"the disk mounted at {small_disk}"):
        Store(small_disk / "store").produce("a", input_hash="h", make=make)
    assert not [path for path in small_disk.rglob("*") if path.is_file()]


def test_the_file_of_the_systems_error_is_the_one_that_is_named(tmp_path: Path) -> None:
    with pytest.raises(DiskFull, match="/dev/full") as full:
        with naming_full_disk(tmp_path / "other"):
            try:
                Path("/dev/full").write_bytes(b"x")
            except OSError as error:
                raise OSError(error.errno, error.strerror, "/dev/full") from error
    assert "mounted at /dev" in str(full.value)


def test_other_errors_stay_as_they_are(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError), naming_full_disk(tmp_path):
        (tmp_path / "none" / "x").write_bytes(b"x")
