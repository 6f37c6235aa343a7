"""Bounds on the errors of real captures with the draft recipe."""

import shutil
from pathlib import Path
from typing import Any

import pytest

from registration.pipeline import register
from tests.conftest import SHARED, needs_shared

pytestmark = [pytest.mark.slow, needs_shared]
CAPTURES = SHARED / "data" / "captures"
MODEL = SHARED / "data" / "gnm" / "gnm_head_reconstructed.npz"


def figures(capture: Path, out: Path) -> dict[str, Any]:
    """Register, print and return the metrics of the face in mm."""
    result = register(capture, MODEL, out)
    face = result.figures["scan_to_mesh"]["face"]
    error = result.figures.get("vertex_error", {}).get("face", {})
    print(f"{capture}: {result.status}, {sum(result.seconds.values()):.0f} s, scan to mesh {face}, vertices {error}")
    assert result.status == "converged", result.reason
    return {"scan": face, "vertices": error}


@pytest.fixture(scope="module")
def ict(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    return figures(CAPTURES / "ict_dev" / "neutral", tmp_path_factory.mktemp("ict") / "out")


def test_the_model_s_own_topology(tmp_path: Path):
    result = figures(CAPTURES / "gnm_identity_a" / "neutral", tmp_path / "out")
    assert result["scan"]["mean_mm"] <= 0.05
    assert result["vertices"]["mean_mm"] <= 0.20


def test_another_topology(ict: dict[str, Any]):
    assert ict["scan"]["mean_mm"] <= 0.18
    assert ict["scan"]["median_mm"] <= 0.07


def test_landmarks_hidden(ict: dict[str, Any], tmp_path: Path):
    source = CAPTURES / "ict_dev" / "neutral"
    hidden = shutil.copytree(source, tmp_path / "capture", ignore=shutil.ignore_patterns("landmarks"))
    result = figures(hidden, tmp_path / "out")
    assert abs(result["scan"]["mean_mm"] - ict["scan"]["mean_mm"]) <= 0.05
