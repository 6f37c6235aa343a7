import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from registration.capture import class_names, label_tables, native
from registration.capture.label_maps import fitting_tables, read_labels
from registration.capture.label_order import guess_order
from registration.degrading import degradation, degrade
from registration.doctor.validation import validate_capture
from registration.errors import InputError
from registration.types import Capture
from tests.registration.capture.small import make

HEIGHT_PX, WIDTH_PX = 160, 120
# One sample of each class of CelebAMask-HQ in our classes; the rest of a map is background.
CELEBAMASK = {
    "skin": "skin",
    "nose": "skin",
    "eye_g": "eye_g",
    "l_eye": "left_eye",
    "r_eye": "right_eye",
    "l_brow": "skin",
    "r_brow": "skin",
    "l_ear": "ears",
    "r_ear": "ears",
    "mouth": "mouth_interior",
    "u_lip": "upper_lip",
    "l_lip": "lower_lip",
    "hair": "hair",
    "hat": "hat",
    "ear_r": "ear_r",
    "neck_l": "neck_l",
    "neck": "neck_other",
    "cloth": "cloth",
}
PARTS = {  # of a face that looks at the camera: centre, half axes, in fractions of the image
    "hair": (0.5, 0.32, 0.36, 0.26),
    "l_ear": (0.79, 0.5, 0.05, 0.08),
    "r_ear": (0.21, 0.5, 0.05, 0.08),
    "neck": (0.5, 0.85, 0.14, 0.16),
    "skin": (0.5, 0.5, 0.28, 0.33),
    "l_brow": (0.63, 0.38, 0.08, 0.015),
    "r_brow": (0.37, 0.38, 0.08, 0.015),
    "l_eye": (0.63, 0.43, 0.05, 0.02),
    "r_eye": (0.37, 0.43, 0.05, 0.02),
    "nose": (0.5, 0.54, 0.05, 0.08),
    "u_lip": (0.5, 0.675, 0.1, 0.02),
    "l_lip": (0.5, 0.725, 0.1, 0.025),
    "mouth": (0.5, 0.7, 0.06, 0.01),
}


def rewritten(root: Path, segmentation: str, maps: np.ndarray | None = None) -> Capture:
    """The capture with other label maps and another [segmentation]."""
    path = root / "capture.toml"
    path.write_text(path.read_text().split("[segmentation")[0] + segmentation)
    if maps is not None:
        for file in (root / "segmentation").glob("*.png"):
            Image.fromarray(maps).save(file)
    return native.read_capture(root)


def labels_of(capture: Capture) -> np.ndarray:
    """The class of each pixel of the first view, as text."""
    view = capture.views[0]
    assert view.segmentation is not None
    return np.array(capture.classes)[read_labels(view.segmentation, view.camera, capture.classes, capture.labels)]


def samples(names: tuple[str, ...]) -> np.ndarray:
    """A map in which index k fills k rows and columns of its own."""
    labels = np.zeros((HEIGHT_PX, WIDTH_PX), np.uint8)
    for index in range(len(names)):
        labels[5 * index : 5 * index + 5, :20] = index
    return labels


def face(names: tuple[str, ...], spelling: dict[str, str] | None = None) -> np.ndarray:
    """A face in the indices of a table; parts that the table lacks are not drawn."""
    labels = np.zeros((320, 240), np.uint8)
    for part, (x, y, a, b) in PARTS.items():
        name = (spelling or {}).get(part, part)
        if name in names:
            centre, axes = (round(240 * x), round(320 * y)), (round(240 * a), round(320 * b))
            cv2.ellipse(labels, centre, axes, 0, 0, 360, names.index(name), -1)
    return labels


LAPA = {
    "l_brow": "right_eyebrow",  # LaPa's left is the image's
    "r_brow": "left_eyebrow",
    "l_eye": "right_eye",
    "r_eye": "left_eye",
    "mouth": "inner_mouth",
    "u_lip": "upper_lip",
    "l_lip": "lower_lip",
}
FACER = {
    "skin": "face",
    "l_ear": "rr",
    "r_ear": "lr",
    "l_brow": "rb",
    "r_brow": "lb",
    "l_eye": "re",
    "r_eye": "le",
    "mouth": "imouth",
    "u_lip": "ulip",
    "l_lip": "llip",
}
GNM = {
    "l_ear": "ears",
    "r_ear": "ears",
    "neck": "neck_other",
    "l_eye": "left_eye",
    "r_eye": "right_eye",
    "u_lip": "upper_lip",
    "l_lip": "lower_lip",
    "mouth": "mouth_interior",
}
SPELLINGS = {"gnm": GNM, "lapa": LAPA, "facer_celebm": FACER, "pixel3dmm": FACER}


def table(name: str) -> label_tables.LabelTable:
    found = label_tables.find(name)
    assert found is not None
    return found


@pytest.mark.parametrize("name", ["celebamask_hq", "celebamask_hq_first", "bisenet"])
def test_maps_in_any_order_of_celebamask_mean_the_same(tmp_path: Path, name: str) -> None:
    names = table(name).names
    capture = rewritten(make(tmp_path / "c"), f'[segmentation]\ntable = "{name}"\n', samples(names))
    shown = labels_of(capture)[:, 10]
    assert len(names) == 19 and len(set(capture.classes)) == len(capture.classes)
    assert {names[k]: str(shown[5 * k]) for k in range(19)} == {"background": "background"} | CELEBAMASK


@pytest.mark.parametrize(
    "name, index, shown",
    [
        ("lapa", 4, "right_eye"),  # "left eye"
        ("lapa", 5, "left_eye"),
        ("lapa", 8, "mouth_interior"),
        ("facer_celebm", 8, "left_eye"),  # "re"
        ("facer_celebm", 9, "right_eye"),
        ("pixel3dmm", 8, "left_eye"),
        ("pixel3dmm", 20, "unlabelled"),
        ("celebamask_hq", 4, "left_eye"),
        ("sapiens", 2, "skin"),
        ("mediapipe_multiclass", 2, "neck_other"),
        ("gnm", 7, "mouth_interior"),
    ],
)
def test_left_and_right_of_tables_are_the_subjects(tmp_path: Path, name: str, index: int, shown: str) -> None:
    maps = samples(table(name).names)
    capture = rewritten(make(tmp_path / "c"), f'[segmentation]\ntable = "{name}"\n', maps)
    assert labels_of(capture)[5 * index, 10] == shown
    other = rewritten(capture.root, f'[segmentation]\ntable = "{name}"\nleft = "subject"\n')
    assert (labels_of(other)[5 * index, 10] == shown) == (table(name).left == "subject" or "eye" not in shown)


def test_every_table_has_a_name_an_index_and_a_source() -> None:
    assert [len(t.names) for t in label_tables.TABLES] == [9, 19, 19, 19, 11, 19, 21, 28, 6]
    assert all(t.source and len(t.colours) in (0, len(t.names)) for t in label_tables.TABLES)
    assert all(class_names.meaning(name) for t in label_tables.TABLES for name in t.names)
    assert all(t.names[0].casefold() == "background" for t in label_tables.TABLES)


@pytest.mark.parametrize("name", ["gnm", "celebamask_hq", "celebamask_hq_first", "bisenet", "lapa", "facer_celebm"])
def test_the_table_of_a_map_is_guessed(name: str) -> None:
    names = table(name).names
    fits = guess_order([face(names, SPELLINGS.get(name))])
    assert fits[0].name == name and {t.name for t in fits} <= {name, "pixel3dmm"}


def test_maps_without_names_are_refused_with_the_table_that_fits(tmp_path: Path) -> None:
    labels = cv2.resize(face(table("bisenet").names), (WIDTH_PX, HEIGHT_PX), interpolation=cv2.INTER_NEAREST)
    capture = rewritten(make(tmp_path / "c"), "", labels)
    with pytest.raises(InputError) as caught:
        validate_capture(capture)
    assert 'table = "bisenet"' in caught.value.fix
    capture = rewritten(capture.root, '[segmentation]\nclasses = ["background", "skin"]\n')
    with pytest.raises(InputError, match="no name") as caught:
        validate_capture(capture)
    assert 'table = "bisenet"' in caught.value.fix and fitting_tables(capture.views) == ["bisenet"]


def test_a_palette_of_ones_own_is_read_in_rgb_rgba_and_indexed_files(tmp_path: Path) -> None:
    labels = samples(("background", "skin", "hair"))
    colours = np.array([[0, 0, 0], [200, 10, 30], [10, 0, 250]], np.uint8)
    text = """[segmentation]
left = "subject"
[segmentation.palette]
background = "#000000"
skin = [[200, 10, 30], "#010203"]
hair = [10, 0, 250]
"""
    root = make(tmp_path / "c")
    expected = np.array(["background", "skin", "hair"])[labels]
    assert (labels_of(rewritten(root, text, colours[labels])) == expected).all()
    rgba = np.dstack([colours[labels], np.full(labels.shape, 255, np.uint8)])
    assert (labels_of(rewritten(root, text, rgba)) == expected).all()
    shuffled = Image.fromarray(np.array([7, 3, 5], np.uint8)[labels], "P")
    shuffled.putpalette([c for k in range(8) for c in (colours[{7: 0, 3: 1, 5: 2}.get(k, 0)])])
    shuffled.save(root / "segmentation" / "cam0.png")
    assert (labels_of(native.read_capture(root)) == expected).all()
    Image.fromarray(labels).save(root / "segmentation" / "cam0.png")
    with pytest.raises(InputError, match="only colours have names"):
        labels_of(native.read_capture(root))


@pytest.mark.parametrize("name", ["celebamask_hq", "lapa", "sapiens"])
def test_the_colours_of_tables_are_read_and_recognized(tmp_path: Path, name: str) -> None:
    known = table(name)
    maps = np.array(known.colours, np.uint8)[samples(known.names)]
    root = make(tmp_path / "c")
    capture = rewritten(root, f'[segmentation]\ntable = "{name}"\n', maps)
    assert [str(labels_of(capture)[5 * k, 10]) for k in range(len(known.names))] == list(known.classes)
    with pytest.raises(InputError, match="in colours") as caught:
        labels_of(rewritten(root, '[segmentation]\nclasses = ["background", "skin"]\n'))
    assert f'table = "{name}"' in caught.value.fix


def test_stray_colours_are_left_out_and_mixed_ones_refused(tmp_path: Path) -> None:
    root = make(tmp_path / "c")
    text = '[segmentation.palette]\nbackground = "#000000"\nskin = "#ff0000"\n'
    rgb = np.zeros((HEIGHT_PX, WIDTH_PX, 3), np.uint8)
    cv2.circle(rgb, (60, 80), 40, (255, 0, 0), -1)
    rgb[80, 50:60] = (1, 2, 3)  # 10 of 19200 pixels
    shown = labels_of(rewritten(root, text, rgb))
    assert (shown == "unlabelled").sum() == 10 and shown[80, 55] == "unlabelled" and shown[0, 0] == "background"
    with pytest.raises(InputError, match="colours are mixed") as caught:
        labels_of(rewritten(root, text, cv2.GaussianBlur(rgb, (5, 5), 0)))
    assert "nearest" in caught.value.fix and "pixels" in str(caught.value.got)
    rgb[:40] = (9, 9, 9)
    with pytest.raises(InputError, match="colours without a name") as caught:
        labels_of(rewritten(root, text, rgb))
    assert "#090909 at 4800 pixels" in str(caught.value.got)


def test_a_jpeg_of_labels_is_refused(tmp_path: Path) -> None:
    root = make(tmp_path / "c")
    path = root / "segmentation" / "cam0.png"
    Image.open(path).convert("RGB").save(root / "labels.jpg", quality=95)
    (root / "labels.jpg").replace(path)
    with pytest.raises(InputError, match="not a map of indices") as caught:
        labels_of(native.read_capture(root))
    assert "JPEG" in str(caught.value.got)


def test_sparse_indices_and_ignored_names_are_read(tmp_path: Path) -> None:
    labels = np.full((HEIGHT_PX, WIDTH_PX), 255, np.uint8)
    labels[40:80], labels[80:] = 7, 30
    text = '[segmentation]\nignore = ["laser"]\n[segmentation.classes]\n7 = "face"\n30 = "laser"\n255 = "background"\n'
    capture = rewritten(make(tmp_path / "c"), text, labels)
    assert labels_of(capture)[[0, 50, 90], 0].tolist() == ["background", "skin", "ignored laser"]
    assert capture.labels.renamed == (("face", "skin"),)


def test_a_mapping_beside_the_capture_is_read(tmp_path: Path) -> None:
    root = make(tmp_path / "c")
    (root / "labels.toml").write_text('table = "lapa"\nleft = "subject"\n')
    capture = rewritten(root, '[segmentation]\nmapping = "labels.toml"\n', samples(table("lapa").names))
    assert labels_of(capture)[20, 10] == "left_eye"
    (tmp_path / "outside.toml").write_text('table = "lapa"\n')
    with pytest.raises(InputError, match="leads out of the capture"):
        rewritten(root, '[segmentation]\nmapping = "../outside.toml"\n')


@pytest.mark.parametrize(
    "text, what, got",
    [
        ('table = "celeb"', "label table is unknown", "celeb"),
        ("table = 3", "label table is unknown", "3"),
        ('table = "lapa"\nclasses = ["skin"]', "lacks the class names", "classes, table"),
        ('left = "image"', "lacks the class names", "left"),
        ('classes = ["background", "skn"]', "class is unknown", "skn"),
        ('classes = ["background", "skin"]\nignore = ["hare"]', "ignored class does not exist", "hare"),
        ('classes = ["background", "skin"]\nignore = "hare"', "ignored classes are malformed", "hare"),
        ('classes = ["background", "skin"]\nleft = "mine"', "side of the labels is unknown", "mine"),
        ('classes = ["background", "skin", "Skin"]', "named twice", "Skin"),
        ('classes = {-1 = "skin"}', "index is malformed", "-1"),
        ('classes = {256 = "skin"}', "index is malformed", "256"),
        ("classes = {1 = 2}", "classes are malformed", "2"),
        ('palette = {skin = "red"}', "colour of the palette is malformed", "red"),
        ("palette = {skin = [1, 2]}", "colour of the palette is malformed", "[1, 2]"),
        ("palette = {skin = [1, 2, 256]}", "colour of the palette is malformed", "256"),
        ('palette = {skin = "#010203", background = "#010203"}', "same colour", "skin and background"),
        ('palette = "reds"', "palette is malformed", "reds"),
        ('mapping = "none.toml"', "mapping of the labels cannot be read", "no such file"),
        ('mapping = 3\ntable = "lapa"', "mapping of the labels is malformed", "3"),
        ('table = "lapa"\ncolors = 3', "unknown key", "colors"),
    ],
)
def test_malformed_segmentation_is_refused(tmp_path: Path, text: str, what: str, got: str) -> None:
    root = make(tmp_path / "c", drop=("normals",))
    with pytest.raises(InputError) as caught:
        rewritten(root, f"[segmentation]\n{text}\n")
    assert what in caught.value.what and got in str(caught.value.got), str(caught.value)


def test_unknown_names_are_refused_with_the_tables_and_the_nearest_name(tmp_path: Path) -> None:
    root = make(tmp_path / "c", drop=("normals",))
    with pytest.raises(InputError) as caught:
        rewritten(root, '[segmentation]\nclasses = ["background", "skn", "xyz", "hair", "Shirt"]\n')
    error = caught.value
    assert error.got == "skn, xyz" and "rename skn to skin" in error.fix and 'ignore = ["xyz"]' in error.fix
    assert all(t.name in str(error.expected) for t in label_tables.TABLES)


def test_a_mouth_without_lips_is_not_the_interior() -> None:
    assert class_names.meanings(["skin", "mouth"])["mouth"] == "skin"
    assert class_names.meanings(["mouth", "u_lip"])["mouth"] == "mouth_interior"
    assert class_names.meanings(["ear_r", "ear_l"]) == {"ear_r": "ears", "ear_l": "ears"}


def test_a_degraded_copy_names_its_own_indices(tmp_path: Path) -> None:
    labels = samples(table("bisenet").names)
    labels[:, 60:] = 1
    text = '[segmentation]\n# mine\ntable = "bisenet"\n'
    capture = rewritten(make(tmp_path / "c", drop=("mask", "landmarks", "normals")), text, labels)
    copy = degrade.degrade(capture.root, tmp_path / "copy", preset=degradation.PRESETS["none"])
    again = native.read_capture(copy)
    assert again.classes == capture.classes and (labels_of(again) == labels_of(capture)).all()
    assert json.dumps(list(capture.classes)) in (copy / "capture.toml").read_text()
