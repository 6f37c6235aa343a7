"""Shared by all tests: shape checks on the library, the location of the shared data, and the condition of GPU tests."""

import ctypes
import sys
from pathlib import Path

import pytest

from tests import annotation_checks

# Before any test module imports the library: every jaxtyping annotation there is checked at run time.
annotation_checks.install(["registration", "coregister"])

ROOT = Path(__file__).resolve().parents[1]
FIXTURES = ROOT / "tests" / "fixtures"
SHARED = ROOT.parent / "shared"
needs_shared = pytest.mark.skipif(not SHARED.is_dir(), reason="no folder 'shared' beside the repository")


def _gpu_missing() -> str | None:
    """Why Dr.Jit's CUDA backend cannot run here, or None; asks the driver, because mitsuba would take seconds."""
    try:
        driver = ctypes.CDLL("libcuda.so.1")
    except OSError:
        return "no NVIDIA driver"
    return "the NVIDIA driver finds no GPU" if driver.cuInit(0) else None


# Files that take more than a minute and a half begin, so that no process waits for another at the end.
LONGEST = (
    "tests/bench/test_benchmarks.py tests/registration/register/test_recovery.py "
    "tests/workflows/test_coregistration.py tests/workflows/web/test_review.py tests/workflows/farm/test_farm.py "
    "tests/test_api.py tests/workflows/cli/test_malformed.py tests/registration/register/test_photographs.py"
).split()


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    places = {ROOT / name: place for place, name in enumerate(LONGEST)}
    items.sort(key=lambda item: places.get(item.path, len(LONGEST)))
    missing = _gpu_missing()
    for item in items:
        if missing and "cuda" in item.keywords:
            item.add_marker(pytest.mark.skip(reason=missing))


def pytest_unconfigure() -> None:
    """Drop the audit's cache: the import hook keeps modules alive at exit, where nanobind would report leaks."""
    if audit := sys.modules.get("registration.evaluate.audit"):
        audit._audited_template.clear()
