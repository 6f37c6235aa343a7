"""Everything that a machine without a network needs to run the package: wheels and a script that installs them."""

import json
import subprocess
import sys
import tempfile
import tomllib
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).resolve().parents[2]
CONSTRAINTS = ROOT / "constraints.txt"
TESTS_NEED = ("pytest", "setuptools")
INSTALL = """#!/bin/sh
# Run in the source's folder. Needs Python {python} with venv, and no network.
set -e
here=$(cd "$(dirname "$0")" && pwd)
python{python} -m venv {site}.venv
.venv/bin/python -m pip install --no-index --no-deps "$here"/wheels/*.whl
.venv/bin/python -m pip install --no-index --no-deps --no-build-isolation --editable .
"""


def make(out: Path, python: str, without: Iterable[str]) -> None:
    """Download wheels of the package, its dependencies and what its tests need.

    Args:
        out: gets `wheels/` and `install.sh`.
        python: the other machine's Python, such as 3.12. It has this machine's platform.
        without: packages that it has already; what they alone need is left out, too.

    Raises:
        CalledProcessError: a pinned version has no wheel for that Python; pip's output says which.
    """
    roots = [*tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["dependencies"], *TESTS_NEED]
    pip = [sys.executable, "-m", "pip"]
    target = ["--python-version", python, "--only-binary=:all:"]
    with tempfile.TemporaryDirectory() as folder:
        report = Path(folder) / "report.json"
        resolve = [*pip, "install", "--dry-run", "--quiet", "--ignore-installed", "--target", folder, *target]
        subprocess.run([*resolve, "--report", str(report), "-c", str(CONSTRAINTS), *roots], check=True)
        found = [item["metadata"] for item in json.loads(report.read_text())["install"]]
    wanted = needed(found, roots, without)
    (out / "wheels").mkdir(parents=True, exist_ok=True)
    download = [*pip, "download", "--quiet", "--no-deps", "--dest", str(out / "wheels"), *target]
    subprocess.run([*download, "-c", str(CONSTRAINTS), *wanted], check=True)
    site = "--system-site-packages " if without else ""
    (out / "install.sh").write_text(INSTALL.format(python=python, site=site))


def needed(found: Iterable[dict[str, Any]], roots: Iterable[str], without: Iterable[str]) -> list[str]:
    """Return NAME==VERSION of what the roots need.

    Args:
        found: metadata of all packages that pip would install.
        roots: requirements to start from.
        without: names that are left out with what they alone need.
    """
    packages = {str(canonicalize_name(metadata["name"])): metadata for metadata in found}
    left_out = {str(canonicalize_name(name)) for name in without}
    wanted: set[str] = set()
    waiting = [str(canonicalize_name(Requirement(root).name)) for root in roots]
    while waiting:
        name = waiting.pop()
        if name in wanted or name in left_out or name not in packages:
            continue
        wanted.add(name)
        requirements = packages[name].get("requires_dist", [])
        waiting += [str(canonicalize_name(Requirement(text).name)) for text in requirements]
    return sorted(f"{packages[name]['name']}=={packages[name]['version']}" for name in wanted)
