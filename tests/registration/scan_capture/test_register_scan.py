"""A bare scan through the command line, in other units and axes, to a registration."""

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from registration.capture.scan import read_scan
from registration.storage.mesh import write_ply
from registration.storage.registration_folder import load_registration
from tests.conftest import SHARED, needs_shared
from workflows.cli.app import main


@needs_shared
@pytest.mark.slow
def test_a_scan_in_millimetres_lying_on_its_side_is_registered(tmp_path: Path) -> None:
    scan = read_scan(SHARED / "data" / "captures" / "ict_dev" / "neutral" / "scan.ply")
    turn = Rotation.from_euler("z", 90, degrees=True).as_matrix()
    write_ply(tmp_path / "head.ply", 1e3 * scan.vertices @ turn.T, scan.triangles)
    model, out = SHARED / "data" / "gnm" / "gnm_head_reconstructed.npz", tmp_path / "out"
    words = ["register", "--scan", str(tmp_path / "head.ply"), "--model", str(model), "--out", str(out)]
    words += ["--recipe", "preview", "--views", "6"]
    assert main(words) == 0
    result = load_registration(out)
    assert result.figures["subject"] == "head" and result.figures["scan_hygiene"]["unit"] == "mm"
    assert result.figures["scan_to_mesh"]["face"]["mean_mm"] < 0.35
    assert result.figures["scan_in_fit"]["surface"] > 0.3  # of the skin; a bare scan has no colours that show it
    assert any("is like the model's" in n for n in result.figures["notes"])
    assert np.ptp(result.vertices, axis=0).argmax() == 0  # it lies on its side, as the scan does
    assert "is like the model&#39;s" in (out / "report.html").read_text("utf-8")
    assert (tmp_path / "out_capture" / "normals").is_dir()
    assert main(words) == 0  # found again, not computed
