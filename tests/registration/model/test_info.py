import io
import shutil

import numpy as np
import pytest
from matplotlib.image import imread
from rich.console import Console

from registration.errors import InputError
from registration.model import info
from tests.fixtures.make_fixtures import HERE


def info_text(path, image=None) -> str:
    stream = io.StringIO()
    info.describe(path, image, Console(file=stream, width=200))
    return stream.getvalue()


def test_the_description_lists_the_contents_of_the_file(tmp_path):
    text = info_text(HERE / "tiny_gnm.npz")
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
    assert "none beside the file" in info_text(tmp_path / "tiny_gnm.npz")


def test_the_image_shows_the_template(tmp_path):
    path = tmp_path / "deep" / "model.png"
    info_text(HERE / "tiny_gnm.npz", path)
    pixels = imread(path)[..., :3]
    front = pixels[:, pixels.shape[1] // 3 : 2 * pixels.shape[1] // 3]
    hue = front / (front.sum(2, keepdims=True) + 1e-9)
    centres = {}
    for name in ("left_eye", "right_eye"):
        colour = np.array(info.COLOURS[name])
        matching = (np.abs(hue - colour / colour.sum()).max(2) < 0.02)[: 2 * len(front) // 3]
        assert matching.sum() > 100, f"no {name} in the image"
        centres[name] = np.argwhere(matching).mean(0)
    # Seen from the front, the subject's left is on the right.
    assert centres["left_eye"][1] > centres["right_eye"][1] + 30
    assert abs(centres["left_eye"][0] - centres["right_eye"][0]) < 10


def test_a_file_that_is_no_model_is_refused(tmp_path):
    with pytest.raises(InputError):
        info_text(HERE / "head_sparse_68.txt", tmp_path / "model.png")
    assert not (tmp_path / "model.png").exists()
