"""A capture with a scan and without normal and label maps: the scan takes their place, and the result says so."""

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from registration.options import RegisterOptions
from registration.report.remarks import remarks
from tests.registration.register.conftest import Run, run
from tests.registration.register.synthetic import Truth

pytestmark = pytest.mark.slow


def without_maps(truth: Truth, root: Path) -> Truth:
    shutil.copytree(truth.root, root, ignore=shutil.ignore_patterns("normals", "segmentation"))
    settings = root / "capture.toml"
    settings.write_text(settings.read_text(encoding="utf-8").split("[segmentation]")[0], encoding="utf-8")
    return replace(truth, root=root)


def result(truth: Truth, folder: Path, use_scan: str) -> Run:
    options = RegisterOptions(recipe="preview", use_scan=use_scan)  # type: ignore[arg-type]
    return run(truth, folder / use_scan, options)


def test_the_scan_takes_the_place_of_normal_maps(neutral: Truth, tmp_path: Path) -> None:
    reduced = without_maps(neutral, tmp_path / "capture")
    measured, fitted = (result(reduced, tmp_path, how) for how in ("never", "auto"))
    before, after = (run.result.figures["scan_to_mesh"]["face"]["mean_mm"] for run in (measured, fitted))
    assert after < 0.5 * before
    assert np.median(fitted.error_mm) < np.median(measured.error_mm)
    used = fitted.result.figures["scan_in_fit"]
    assert used["normals"] == 8 and 0.5 < used["surface"] <= 1
    assert [line for line in remarks(fitted.result) if line.startswith("The scan took part in the fit: its normals in")]
    assert "scan_in_fit" not in measured.result.figures and "scan" not in str(measured.result.history)


def test_normal_maps_keep_the_scan_out_unless_it_is_asked_for(neutral: Truth, tmp_path: Path) -> None:
    used = result(neutral, tmp_path, "always").result.figures["scan_in_fit"]
    assert used["normals"] == 0 and used["surface"] > 0.5
