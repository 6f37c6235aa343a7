"""A registration that corrects its cameras, as a folder."""

import shutil
from pathlib import Path

import numpy as np
import pytest

from registration.capture.native import read_capture
from registration.options import RegisterOptions
from registration.pipeline import register
from registration.storage.registration_folder import load_registration
from tests.registration.register import synthetic


@pytest.mark.slow
def test_the_corrected_cameras_can_replace_the_given_ones(tmp_path: Path) -> None:
    root, out = synthetic.make(tmp_path / "capture").root, tmp_path / "out"
    register(root, synthetic.MODEL, out, RegisterOptions(recipe="preview", camera_sigma_px=0.5))
    figure = load_registration(out).figures["cameras"]
    assert figure["sigma_px"] == 0.5 and figure["warnings"] == []
    assert all(row["shift_px"] < 0.1 for row in figure["views"].values())  # the cameras are exact
    shutil.rmtree(root / "sparse")
    shutil.copytree(out / "sparse", root / "sparse")
    for view in read_capture(root).views:
        row = figure["views"][view.name]
        np.testing.assert_allclose(view.camera.T_cam_world, row["T_cam_world"], atol=1e-9)
        np.testing.assert_allclose(view.camera.intrinsics, row["intrinsics"], atol=1e-6)
    assert "sigma" in (out / "report.html").read_text("utf-8")
    register(root, synthetic.MODEL, out, RegisterOptions(recipe="preview"))  # and the folder can be replaced
    assert not (out / "sparse").exists()
