import io
import shutil

import numpy as np
import pytest
from matplotlib.image import imread
from rich.console import Console

from registration.errors import InputError
from registration.model import info
from tests.fixtures.make_fixtures import HERE


def told(path, picture=None) -> str:
    stream = io.StringIO()
    info.describe(path, picture, Console(file=stream, width=200))
    return stream.getvalue()


def test_tells_what_the_file_holds(tmp_path):
    text = told(HERE / "tiny_gnm.npz")
    rows = [line.split() for line in text.splitlines()]
    for row in (
        ["vertices", "1,163"],
        ["triangles", "2,256"],
        ["identity", "6"],
        ["expression", "7"],
        ["skin", "889", "1,728"],
        ["left_eye", "head", "31.0", "304.0", "104.0"],
        ["class", "left_eye", "98"],
        ["mouth_sock", "0"],
    ):
        assert row in rows
    assert "all zero" in text and "68 (68 points)" in text
    shutil.copy(HERE / "tiny_gnm.npz", tmp_path)
    assert "none beside the file" in told(tmp_path / "tiny_gnm.npz")


def test_draws_the_template(tmp_path):
    path = tmp_path / "deep" / "model.png"
    told(HERE / "tiny_gnm.npz", path)
    pixels = imread(path)[..., :3]
    front = pixels[:, pixels.shape[1] // 3 : 2 * pixels.shape[1] // 3]
    hue = front / (front.sum(2, keepdims=True) + 1e-9)
    centres = {}
    for name in ("left_eye", "right_eye"):
        colour = np.array(info.COLOURS[name])
        found = (np.abs(hue - colour / colour.sum()).max(2) < 0.02)[: 2 * len(front) // 3]
        assert found.sum() > 100, f"no {name} in the picture"
        centres[name] = np.argwhere(found).mean(0)
    # Seen from the front, the subject's left is on the right.
    assert centres["left_eye"][1] > centres["right_eye"][1] + 30
    assert abs(centres["left_eye"][0] - centres["right_eye"][0]) < 10


def test_refuses_what_is_no_model(tmp_path):
    with pytest.raises(InputError):
        told(HERE / "head_sparse_68.txt", tmp_path / "model.png")
    assert not (tmp_path / "model.png").exists()
