from pathlib import Path

import numpy as np
import pytest

from registration.detect.map_renders import RenderSettings
from registration.errors import InputError
from registration.model import gnm_npz
from registration.model.landmarks import read_scheme
from registration.progress import NullProgress
from tests.fixtures.make_fixtures import tiny_model
from workflows.steps import landmark_map

PROVIDER = "tests.workflows.steps.test_landmark_map:centroid_provider"


class _Centroid:
    """Marks the middle of what is not background, and two points beside it."""

    scheme, count, version = "three", 3, "centroid 1"

    def detect(self, image):
        from registration.detect.provider import Face

        covered = np.abs(image.astype(int) - image[0, 0].astype(int)).max(2) > 40
        y, x = np.nonzero(covered)
        centre, side = np.array([x.mean(), y.mean()]), 0.1 * np.ptp(x)
        points = centre + np.array([[0, 0], [-side, 0], [side, 0]])
        box = np.array([x.min(), y.min(), x.max(), y.max()], float)
        return [Face(points=points, confidence=np.ones(3), spread_px=np.ones(3), presence=0.9, box=box)]


def centroid_provider():
    return _Centroid()


@pytest.fixture
def model(tmp_path: Path) -> Path:
    path = tmp_path / "model.npz"
    gnm_npz.write(tiny_model(), path)
    return path


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"provider": "face479"}, "landmark provider"),
        ({"settings": RenderSettings(identities=1)}, "number of rendered heads"),
        ({"settings": RenderSettings(seed=-1)}, "seed"),
        ({"out": Path("model.npz")}, "exists already"),
        ({"model": Path("missing.npz")}, "missing.npz"),
    ],
)
def test_bad_input_is_refused_before_rendering(changes, message, model, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(landmark_map, "make_map", lambda *_: pytest.fail("rendered"))
    given = {"model": model, "provider": "face478", "out": None, "settings": RenderSettings(), "picture": None}
    with pytest.raises(InputError, match=message):
        landmark_map.make_landmark_map(**(given | changes), progress=NullProgress())


@pytest.mark.slow
def test_a_map_of_any_provider_is_written_beside_the_model(model, tmp_path):
    settings = RenderSettings(identities=4, expressions=1)
    path, lines = landmark_map.make_landmark_map(model, PROVIDER, None, settings, tmp_path / "map.png", NullProgress())
    assert path == tmp_path / "head_sparse_three.txt" and (tmp_path / "map.png").exists()
    data = gnm_npz.read(model)
    scheme = read_scheme(path, data.template_vertex_positions)
    assert scheme.header["provider"] == "centroid 1" and scheme.header["scheme"] == "three"
    assert scheme.header["topology"] == gnm_npz.topology_hash(data.triangles)
    assert scheme.spread_m is not None and scheme.spread_m.shape == (3,)
    points = scheme.points(data.template_vertex_positions)
    assert abs(points[0, 0]) < 5e-3 and points[1, 0] < 0 < points[2, 0]
    assert "faces found in 100.0% of the pictures" in lines
