import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from registration.errors import InputError
from registration.render import llvm

OLD = [path for folder in Path("/usr/lib").glob("*-linux-gnu") for path in sorted(folder.glob("libLLVM-1[45].so.1"))]
needs_old = pytest.mark.skipif(not OLD, reason="no libLLVM 14 or 15 on this machine")


@pytest.fixture(autouse=True)
def clean_environment(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """No library set, nothing cached; settings of a test are undone after it."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setenv(llvm.ENVIRONMENT, "")
    monkeypatch.delenv(llvm.ENVIRONMENT)


def prefer_an_old_library(monkeypatch: pytest.MonkeyPatch, folder: Path) -> None:
    """Make Dr.Jit's default library one that aborts the process: it asks the loader for `libLLVM.so` first."""
    folder.mkdir()
    (folder / "libLLVM.so").symlink_to(OLD[-1])
    monkeypatch.setenv("LD_LIBRARY_PATH", str(folder))


def test_a_library_is_located_and_set_for_drjit() -> None:
    library = llvm.ensure_usable()
    assert library.is_file() and "libLLVM" in library.name
    assert os.environ[llvm.ENVIRONMENT] == str(library)


def test_the_check_is_cached_until_the_library_changes(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    library = llvm.ensure_usable()
    monkeypatch.setattr(llvm, "_PROBE", "raise SystemExit('probed again')")
    assert llvm.ensure_usable() == library, "named in the environment by the first call"
    monkeypatch.delenv(llvm.ENVIRONMENT)
    assert llvm.ensure_usable() == library, "Dr.Jit's own choice"

    cache = tmp_path / "cache" / "gnm-registration" / "llvm.json"
    known = json.loads(cache.read_text())
    known[str(library)]["mtime_ns"] -= 1
    cache.write_text(json.dumps(known))
    with pytest.raises(InputError) as error:
        llvm.ensure_usable()
    assert "probed again" in error.value.got


@pytest.mark.parametrize("content", ["", "[]", "{}", '{"": {"library": "/nowhere"}}'])
def test_a_corrupt_cache_is_rebuilt(content: str, tmp_path: Path) -> None:
    cache = tmp_path / "cache" / "gnm-registration" / "llvm.json"
    cache.parent.mkdir(parents=True)
    cache.write_text(content)
    library = llvm.ensure_usable()
    assert json.loads(cache.read_text())[""]["library"] == str(library)


def test_an_unwritable_cache_is_no_error(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    assert llvm.ensure_usable().is_file()


@needs_old
@pytest.mark.parametrize("library", OLD, ids=lambda path: path.name)
def test_a_named_library_that_kills_the_process_is_an_error(library: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(llvm.ENVIRONMENT, str(library))
    with pytest.raises(InputError) as error:
        llvm.ensure_usable()
    assert library.name in error.value.where and llvm.ENVIRONMENT in error.value.where
    assert "too old" in error.value.got or "fminimum" in error.value.got
    assert "16 or newer" in error.value.expected
    assert llvm.ENVIRONMENT in error.value.fix


def test_a_named_library_that_is_missing_is_an_error(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv(llvm.ENVIRONMENT, str(tmp_path / "libLLVM.so"))
    with pytest.raises(InputError) as error:
        llvm.ensure_usable()
    assert "no such file" in error.value.got


@needs_old
def test_a_newer_library_replaces_an_unusable_library(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    prefer_an_old_library(monkeypatch, tmp_path / "lib")
    _, failure = llvm._probe(None)
    assert "fminimum" in failure or "too old" in failure
    newest = llvm._installed()[0]
    assert llvm.ensure_usable() == Path(newest)
    assert os.environ[llvm.ENVIRONMENT] == newest


@needs_old
def test_without_any_library_the_error_contains_the_install_command(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    prefer_an_old_library(monkeypatch, tmp_path / "lib")
    monkeypatch.setattr(llvm, "_installed", list)
    with pytest.raises(InputError) as error:
        llvm.ensure_usable()
    assert error.value.fix.startswith("sudo apt-get install -y libllvm")
    assert llvm.ENVIRONMENT not in os.environ


def test_the_setup_command_prints_the_library_and_imports_no_renderer() -> None:
    code = "import sys; from registration.render import llvm; print(*sys.modules)"
    modules = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.split()
    assert {"mitsuba", "drjit", "torch", "numpy"}.isdisjoint(modules)
    run = subprocess.run([sys.executable, "-m", "registration.render.llvm"], capture_output=True, text=True, check=True)
    assert Path(run.stdout.strip()).is_file()


@needs_old
def test_the_setup_command_fails_with_exit_code_1(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(llvm.ENVIRONMENT, str(OLD[-1]))
    command = [sys.executable, "-m", "registration.render.llvm", "--install"]
    run = subprocess.run(command, capture_output=True, text=True)
    assert run.returncode == 1
    assert "no usable LLVM" in run.stderr and "Traceback" not in run.stderr
