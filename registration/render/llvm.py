"""Finds a libLLVM with which Dr.Jit can render on the CPU, without risking this process.

Dr.Jit 1.5.0 *aborts* the process with a libLLVM older than 16: version 15 cannot select an instruction for `minimum`,
version 14 switches the backend off and the first kernel divides by zero. So the first such kernel runs in a child
process, and the library that passed is named to Dr.Jit in `DRJIT_LIBLLVM_PATH`. Linux only.
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

# drjit alone, not mitsuba: the same code generator in a fifth of the time.
_PROBE = """
import drjit
from drjit.llvm import Float
assert list(drjit.minimum(Float(1, 4), Float(3, 2))) == [1, 2]
print(next(line.split(maxsplit=5)[5].strip() for line in open("/proc/self/maps") if "libLLVM" in line))
"""


def ensure_usable() -> Path:
    """The libLLVM that Dr.Jit will load, proven to compile and run a kernel; call it before importing drjit.

    A library that the user names in `DRJIT_LIBLLVM_PATH` is the only one tried; else Dr.Jit's own choice is tried,
    then every installed version from 16 on, newest first. The one that passes is set in `DRJIT_LIBLLVM_PATH` of this
    process, and is remembered until the file or drjit changes.

    Raises:
        InputError: no library passes; the message has the command that installs one.
    """
    named = os.environ.get(ENVIRONMENT)
    library = _recall(named) or _find(named)
    os.environ[ENVIRONMENT] = str(library)
    return library


def install() -> Path:
    """As `ensure_usable`; where no library passes, root on Debian or Ubuntu first gets one from the distribution.

    Raises:
        InputError: no library passes and none was installed.
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
    """Probe libraries until one passes, and remember it."""
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
        fix=f"unset {ENVIRONMENT}, or name another library there"
        if named
        else f"sudo apt-get install -y {' '.join(_packages())}",
    )


def _probe(candidate: str | None) -> tuple[Path | None, str]:
    """Compile and run one `minimum` kernel in a child process: the library that was loaded, or why it failed."""
    environment = {key: value for key, value in os.environ.items() if key != ENVIRONMENT}
    if candidate:
        if not Path(candidate).is_file():
            return None, "no such file"
        environment[ENVIRONMENT] = candidate
    with tempfile.TemporaryDirectory() as empty:
        environment["DRJIT_CACHE_DIR"] = empty  # a kernel from Dr.Jit's own cache would prove nothing
        try:
            run = subprocess.run(
                [sys.executable, "-P", "-c", _PROBE], env=environment, capture_output=True, text=True, timeout=120
            )
        except subprocess.TimeoutExpired:
            return None, "no answer within 120 s"
    if run.returncode == 0:
        return Path(run.stdout.splitlines()[-1]), ""
    lines = [line.strip() for line in run.stderr.splitlines() if line.strip()]
    # LLVM and Dr.Jit say the reason first; of chained Python errors the first one is the cause.
    told = ([line for line in lines if re.match(r"[\w.]+Error: ", line)] or lines or ["no message"])[0]
    return None, f"{told} (exit code {run.returncode})"


def _installed() -> list[str]:
    """Every libLLVM that is new enough by its name, newest first."""
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
    """What to install: the distribution's libLLVM nearest to the tested one."""
    wanted, *rest = PACKAGES
    found = ""
    if shutil.which("apt-cache"):
        found = subprocess.run(
            ["apt-cache", "search", "--names-only", r"^libllvm[0-9]+(t64)?$"], capture_output=True, text=True
        ).stdout
    offers = {line.split()[0]: int(re.findall(r"\d+", line)[0]) for line in found.splitlines()}
    usable = [name for name, major in offers.items() if major >= OLDEST_MAJOR]
    return [min(usable, key=lambda name: abs(offers[name] - TESTED_MAJOR), default=wanted), *rest]


def _cache_file() -> Path:
    """Where proofs are kept. Raises RuntimeError for a user without a home."""
    return cache_folder() / "llvm.json"


def _fingerprint(library: Path) -> dict[str, str | int]:
    """What must be unchanged for an earlier proof to hold. Raises OSError if the library is gone."""
    status = library.stat()
    drjit = importlib.metadata.version("drjit")
    return {"library": str(library), "mtime_ns": status.st_mtime_ns, "bytes": status.st_size, "drjit": drjit}


def _recall(named: str | None) -> Path | None:
    """The library that passed before for the same `DRJIT_LIBLLVM_PATH`, if it is still the same."""
    try:
        proven = json.loads(_cache_file().read_text())[named or ""]
        library = Path(proven["library"])
        return library if _fingerprint(library) == proven else None
    except (OSError, ValueError, LookupError, TypeError, RuntimeError):
        return None


def _remember(named: str | None, library: Path) -> None:
    """Keep the proof; a home that is missing or read-only costs a probe each time and no more."""
    with contextlib.suppress(OSError, RuntimeError):
        file = _cache_file()
        try:
            known = dict(json.loads(file.read_text()))
        except (OSError, ValueError, TypeError):
            known = {}
        # Under its own path too: this process and its children find it named in their environment from now on.
        known |= dict.fromkeys([named or "", str(library)], _fingerprint(library))
        file.parent.mkdir(parents=True, exist_ok=True)
        write_json(file, known)


if __name__ == "__main__":
    try:
        print(install() if "--install" in sys.argv[1:] else ensure_usable())
    except InputError as error:
        sys.exit(str(error))
