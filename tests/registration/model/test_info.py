import io
import json
import shutil

import numpy as np
import pytest
from matplotlib.image import imread
from rich.console import Console

from registration.errors import InputError
from registration.model import gnm_npz, gnmw, info
from registration.storage.hashing import hash_file
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
    assert "all zero" in text and "68 (68 points, the jaw in the corrected order)" in text
    data = gnm_npz.read(HERE / "tiny_gnm.npz")
    for name, value in (
        ("version", "3.0, variant head"),
        ("other fields", "none"),
        ("content id", gnm_npz.content_hash(data)),
        ("topology id", gnm_npz.topology_hash(data.triangles)),
        ("sha256 of the file", hash_file(HERE / "tiny_gnm.npz")),
        ("source", "not recorded"),
    ):
        assert any(line.startswith(f"{name} ") and line.rstrip().endswith(f" {value}") for line in text.splitlines())
    shutil.copy(HERE / "tiny_gnm.npz", tmp_path)
    assert "none beside the file" in info_text(tmp_path / "tiny_gnm.npz")


def test_origin_fields_and_order_are_told(tmp_path):
    path = tmp_path / "model.npz"
    with np.load(HERE / "tiny_gnm.npz") as archive:
        np.savez(path, **archive, rounds=np.arange(3))
    np.savez(tmp_path / "model.extra.npz", weather=np.zeros(2))
    rows = (HERE / "head_sparse_68.txt").read_text().splitlines()
    (tmp_path / "head_sparse_68.txt").write_text("\n".join([*rows[:2], *rows[6:1:-1], *rows[7:]]))
    record = {
        "kind": "gnm-model-source",
        "schema": 1,
        "source": "kaggle",
        "address": "https://a.b",
        "licence": "Apache-2.0",
    }
    path.with_suffix(".source.json").write_text(json.dumps({**record, "sha256": hash_file(path)}))
    text = info_text(path)
    for line in (
        "other fields                 rounds, weather",
        "of these in the second file  weather",
        "source                       kaggle: https://a.b",
        "licence                      Apache-2.0",
        "landmark schemes: 68 (68 points, 2-6 of the right jaw reversed in the file)",
        "note: fields of the model outside version 3.0, kept and not used: rounds, weather",
    ):
        assert any(shown.rstrip() == line for shown in text.splitlines()), line
    path.with_suffix(".source.json").unlink()
    (tmp_path / "model.manifest.json").write_text("{}")
    assert "built; see model.manifest.json" in info_text(path)


def test_a_gnmw_file_is_described(tmp_path):
    gnmw.write(gnmw.web_model(gnm_npz.read(HERE / "tiny_gnm.npz")), tmp_path / "tiny.gnmw")
    stream = io.StringIO()
    info.describe_web(tmp_path / "tiny.gnmw", Console(file=stream, width=200))
    rows = [line.split() for line in stream.getvalue().splitlines()]
    assert ["vertices", "1,163"] in rows and ["triangles", "2,256"] in rows
    assert any(row[:2] == ["identity", "6"] for row in rows) and any(row[:2] == ["expression", "7"] for row in rows)
    assert hash_file(tmp_path / "tiny.gnmw") in stream.getvalue()


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
