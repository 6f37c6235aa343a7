from pathlib import Path

import cv2
import numpy as np

from registration.report.stages import write_stage
from tests.report.test_pictures import HEIGHT, WIDTH, a_view


def test_a_row_for_each_view_target_rendering_difference_normals(tmp_path: Path) -> None:
    whole = vars(a_view())
    narrow = a_view(**{name: value[:, :20] for name, value in whole.items() if isinstance(value, np.ndarray)})
    file = write_stage(tmp_path / "stages" / "00_start.png", (a_view(), narrow))
    picture = cv2.imread(str(file))[..., ::-1] / 255.0
    assert picture.shape == (2 * HEIGHT, 4 * WIDTH, 3)
    inside = picture[20, 15::WIDTH]
    expected = [[0.4] * 3, [0.5] * 3, [0.4] * 3, 0.5 + 0.5 * np.array([np.sin(np.radians(10)), 0, 0.985])]
    assert np.abs(inside - expected).max() < 0.01
    assert not picture[HEIGHT:, 80:].any()
