from pathlib import Path

import cv2
import numpy as np

from registration.capture.scan import read_scan
from registration.report.stage_snapshots import write_stage
from tests.registration.report.test_pictures import HEIGHT, WIDTH, a_view


def test_a_row_for_each_view_target_rendering_difference_normals(tmp_path: Path) -> None:
    fields = vars(a_view())
    narrow = a_view(**{name: value[:, :20] for name, value in fields.items() if isinstance(value, np.ndarray)})
    vertices, triangles = np.random.default_rng(0).normal(size=(5, 3)), np.array([[0, 1, 2], [2, 3, 4]])
    file = write_stage(tmp_path / "stages", "00_start", (a_view(), narrow), vertices, triangles)
    image = cv2.imread(str(file.with_suffix(".png")))[..., ::-1] / 255.0
    assert image.shape == (2 * HEIGHT, 4 * WIDTH, 3)
    inside = image[20, 15::WIDTH]
    expected = [[0.4] * 3, [0.5] * 3, [0.4] * 3, 0.5 + 0.5 * np.array([np.sin(np.radians(10)), 0, 0.985])]
    assert np.abs(inside - expected).max() < 0.01
    assert not image[HEIGHT:, 80:].any()
    mesh = read_scan(file)
    np.testing.assert_allclose(mesh.vertices, vertices, atol=1e-6)
    assert np.array_equal(mesh.triangles, triangles)
    assert {path.name for path in file.parent.iterdir()} == {"00_start.png", "00_start.ply"}
