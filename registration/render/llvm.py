"""Selection of a libLLVM with which Dr.Jit can render on the CPU, tested in a child process.

Dr.Jit 1.5.0 *aborts* the process with a libLLVM older than 16: version 15 cannot select an instruction for `minimum`,
version 14 disables the backend and the first kernel divides by zero. Therefore such a kernel is first run in a child
process, and the library that passes is set in `DRJIT_LIBLLVM_PATH` for Dr.Jit. Linux only.
"""

import contextlib
import importlib.metadata
import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

from registration.errors import InputError
from registration.storage.cache import cache_folder
from registration.storage.files import write_json

ENVIRONMENT = "DRJIT_LIBLLVM_PATH"
OLDEST_MAJOR = 16
TESTED_MAJOR = 19
PACKAGES = (f"libllvm{TESTED_MAJOR}", "libatomic1")  # Dr.Jit links libatomic, which a minimal Debian lacks

# drjit without mitsuba: the same code generator, in a fifth of the time.
_PROBE = """
import drjit
from drjit.llvm import Float
assert list(drjit.minimum(Float(1, 4), Float(3, 2))) == [1, 2]
print(next(line.split(maxsplit=5)[5].strip() for line in open("/proc/self/maps") if "libLLVM" in line))
"""


def ensure_usable() -> Path:
    """Find a libLLVM that compiles and runs a kernel, and set it in `DRJIT_LIBLLVM_PATH` of this process.

    To be called before drjit is imported. If the user has set `DRJIT_LIBLLVM_PATH`, only that library is tested;
    otherwise Dr.Jit's own choice, then every installed version from 16 on, newest first. The result is cached until the
    library or drjit changes.

    Returns:
        The library's path.

    Raises:
        InputError: no library passes; the message has the command that installs one.
    """
    named = os.environ.get(ENVIRONMENT)
    library = _recall(named) or _find(named)
    os.environ[ENVIRONMENT] = str(library)
    return library


def install() -> Path:
    """Do as `ensure_usable`; if no library passes, install one with apt-get, as root on Debian or Ubuntu.

    Returns:
        The library's path.

    Raises:
        InputError: no library passes, also after the installation.
    """
    try:
        return ensure_usable()
    except InputError:
        if os.geteuid() != 0 or not shutil.which("apt-get") or os.environ.get(ENVIRONMENT):
            raise
    subprocess.run(["apt-get", "update", "-q"], check=False)
    quiet = os.environ | {"DEBIAN_FRONTEND": "noninteractive"}
    subprocess.run(["apt-get", "install", "-y", "-q", "--no-install-recommends", *_packages()], check=False, env=quiet)
    return ensure_usable()


def _find(named: str | None) -> Path:
    """Test libraries until one passes, and cache the result."""
    failures = {}
    for candidate in [named] if named else [None, *_installed()]:
        library, failure = _probe(candidate)
        if library:
            _remember(named, library)
            return library
        failures[candidate or "Dr.Jit's own choice"] = failure
    raise InputError(
        "The CPU renderer has no usable LLVM",
        where=f"{ENVIRONMENT}={named}" if named else "this machine's libraries",
        expected=f"libLLVM {OLDEST_MAJOR} or newer ({TESTED_MAJOR} is tested)",
        got="; ".join(f"{candidate}: {failure}" for candidate, failure in failures.items()),
        fix=f"unset {ENVIRONMENT}, or set it to another library"
        if named
        else f"sudo apt-get install -y {' '.join(_packages())}",
    )


def _probe(candidate: str | None) -> tuple[Path | None, str]:
    """Run a `minimum` kernel in a child process; return the library that was loaded, or None and the reason."""
    environment = {key: value for key, value in os.environ.items() if key != ENVIRONMENT}
    if candidate:
        if not Path(candidate).is_file():
            return None, "no such file"
        environment[ENVIRONMENT] = candidate
    with tempfile.TemporaryDirectory() as empty:
        environment["DRJIT_CACHE_DIR"] = empty  # a kernel from Dr.Jit's cache would not be compiled
        try:
            run = subprocess.run(
                [sys.executable, "-P", "-c", _PROBE], env=environment, capture_output=True, text=True, timeout=120
            )
        except subprocess.TimeoutExpired:
            return None, "no result within 120 s"
    if run.returncode == 0:
        return Path(run.stdout.splitlines()[-1]), ""
    lines = [line.strip() for line in run.stderr.splitlines() if line.strip()]
    # The first line of LLVM and Dr.Jit has the reason; of chained Python errors the first one is the cause.
    reason = ([line for line in lines if re.match(r"[\w.]+Error: ", line)] or lines or ["no message"])[0]
    return None, f"{reason} (exit code {run.returncode})"


def _installed() -> list[str]:
    """Return every installed libLLVM that is new enough by its file name, newest first."""
    folders = [*map(Path, ("/usr/local/lib", "/usr/lib", "/usr/lib64")), *Path("/usr/lib").glob("*-linux-gnu")]
    folders += [Path(folder) for folder in os.environ.get("LD_LIBRARY_PATH", "").split(":") if folder]
    folders += Path("/usr/lib").glob("llvm-*/lib")
    versions = {}
    for file in {file.resolve() for folder in folders for file in folder.glob("libLLVM*.so*")}:
        if match := re.fullmatch(r"libLLVM(?:-(\d+)[\d.]*\.so[\d.]*|\.so\.(\d+)[\d.]*)", file.name):
            versions[str(file)] = int(match[1] or match[2])
    new_enough = [library for library, major in versions.items() if major >= OLDEST_MAJOR]
    return sorted(new_enough, key=lambda library: (-versions[library], library))


def _packages() -> list[str]:
    """Return the packages to install: the distribution's libLLVM nearest to the tested one, and its dependencies."""
    default, *others = PACKAGES
    listing = ""
    if shutil.which("apt-cache"):
        listing = subprocess.run(
            ["apt-cache", "search", "--names-only", r"^libllvm[0-9]+(t64)?$"], capture_output=True, text=True
        ).stdout
    versions = {line.split()[0]: int(re.findall(r"\d+", line)[0]) for line in listing.splitlines()}
    usable = [name for name, major in versions.items() if major >= OLDEST_MAJOR]
    return [min(usable, key=lambda name: abs(versions[name] - TESTED_MAJOR), default=default), *others]


def _cache_file() -> Path:
    """Return the file of cached results. Raises RuntimeError for a user without a home folder."""
    return cache_folder() / "llvm.json"


def _fingerprint(library: Path) -> dict[str, str | int]:
    """Return what must be unchanged for a cached result to be valid. Raises OSError if the library does not exist."""
    status = library.stat()
    drjit = importlib.metadata.version("drjit")
    return {"library": str(library), "mtime_ns": status.st_mtime_ns, "bytes": status.st_size, "drjit": drjit}


def _recall(named: str | None) -> Path | None:
    """Return the cached library for this `DRJIT_LIBLLVM_PATH`, if it has not changed, else None."""
    try:
        saved = json.loads(_cache_file().read_text())[named or ""]
        library = Path(saved["library"])
        return library if _fingerprint(library) == saved else None
    except (OSError, ValueError, LookupError, TypeError, RuntimeError):
        return None


def _remember(named: str | None, library: Path) -> None:
    """Cache the result; without a writable home the test is repeated in every process."""
    with contextlib.suppress(OSError, RuntimeError):
        file = _cache_file()
        try:
            results = dict(json.loads(file.read_text()))
        except (OSError, ValueError, TypeError):
            results = {}
        # Also under its own path, which this process and its children now have in their environment.
        results |= dict.fromkeys([named or "", str(library)], _fingerprint(library))
        file.parent.mkdir(parents=True, exist_ok=True)
        write_json(file, results)


if __name__ == "__main__":
    try:
        print(install() if "--install" in sys.argv[1:] else ensure_usable())
    except InputError as error:
        sys.exit(str(error))
