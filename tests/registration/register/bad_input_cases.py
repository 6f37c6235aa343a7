"""Requests that must be refused before any computation, with the expected messages."""

import json
import os
import pickle
import shutil
import zipfile
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from registration.model import gnm_npz
from registration.model.atlas import texture_atlas
from registration.model.gnm import GNM
from registration.options import RegisterOptions
from registration.pipeline import register
from registration.storage.registration_folder import load_registration, save_registration
from registration.types import Registration


@dataclass(kw_only=True)
class Request:
    """The arguments of one `register` call, in a separate folder."""

    folder: Path
    capture: Path
    model: Path
    out: Path
    options: dict[str, Any] = field(default_factory=dict)

    def register(self) -> Registration:
        settings = {name: self.options[name] for name in ("neutral", "force") if name in self.options}
        options = {name: value for name, value in self.options.items() if name not in settings}
        return register(self.capture, self.model, self.out, RegisterOptions(**options), **settings)

    def change_model(self, **arrays: np.ndarray | None) -> None:
        """Replace arrays of the model file, or remove those that are None."""
        with np.load(self.model) as archive:
            arrays_of_model = {name: archive[name] for name in archive.files} | arrays
        self.model.unlink()  # may be a link to the fixture
        np.savez(self.model, **{name: array for name, array in arrays_of_model.items() if array is not None})


Damage = Callable[[Request], None]
BAD: dict[str, tuple[Damage, str, str, str, str]] = {}  # name -> damage, what, where, got, fix


def bad(what: str, *, where: str, got: str, fix: str) -> Callable[[Damage], Damage]:
    """Add a case to the table: a phrase of each part of the expected message."""

    def add(damage: Damage) -> Damage:
        BAD[damage.__name__] = (damage, what, where, got, fix)
        return damage

    return add


def edit(path: Path, old: str, new: str) -> None:
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))


def edit_line(path: Path, start: str, change: Callable[[list[str]], list[str]]) -> None:
    """Change words in the lines that start with `start`."""
    lines = path.read_text().splitlines()
    (number,) = [i for i, line in enumerate(lines) if line.startswith(start)]
    lines[number] = " ".join(change(lines[number].split()))
    path.write_text("\n".join(lines) + "\n")


def crop(path: Path) -> None:
    assert cv2.imwrite(str(path), cv2.imread(str(path), cv2.IMREAD_UNCHANGED)[:, :-2])


# The capture


@bad("The capture folder is missing", where="capture", got="no such folder", fix="check the path")
def capture_missing(request: Request) -> None:
    shutil.rmtree(request.capture)


@bad("The units are not metres", where="capture.toml", got="mm", fix="docs/formats.md")
def units_declared_as_millimetres(request: Request) -> None:
    edit(request.capture / "capture.toml", '"m"', '"mm"')


@bad("eye corners are too close or too far apart", where="sparse", got="95.", fix="0.001")
def capture_in_millimetres(request: Request) -> None:
    for number in range(1, 9):
        edit_line(
            request.capture / "sparse" / "images.txt",
            f"{number} ",
            lambda words: [*words[:5], *(str(1000 * float(word)) for word in words[5:8]), *words[8:]],
        )


@bad("The image is missing", where="images/cam3.png", got="no such file", fix="add the file")
def image_missing(request: Request) -> None:
    (request.capture / "images" / "cam3.png").unlink()


@bad("The image's size is not the camera's", where="images/cam2.png", got="158 x 200", fix="calibrated image")
def image_of_another_size(request: Request) -> None:
    crop(request.capture / "images" / "cam2.png")


@bad("The image is truncated", where="images/cam6.png", got="bytes", fix="again")
def image_truncated(request: Request) -> None:
    path = request.capture / "images" / "cam6.png"
    path.write_bytes(path.read_bytes()[:-3000])


@bad("The camera model is not supported", where="image cam4.png", got="THIN_PRISM_FISHEYE", fix="gnmreg capture import")
def camera_model_unsupported(request: Request) -> None:
    edit_line(
        request.capture / "sparse" / "cameras.txt",
        "5 ",
        lambda words: [words[0], "THIN_PRISM_FISHEYE", *words[2:], *["0.01"] * 8],
    )


@bad("The pose is singular or not finite", where="image cam0.png", got="quaternion", fix="calibrate")
def pose_singular(request: Request) -> None:
    edit_line(request.capture / "sparse" / "images.txt", "1 ", lambda words: [words[0], *["0"] * 4, *words[5:]])


@bad("The pose is singular or not finite", where="images.txt, line", got="inf", fix="calibrate")
def pose_not_finite(request: Request) -> None:
    edit_line(request.capture / "sparse" / "images.txt", "2 ", lambda words: [*words[:6], "inf", *words[7:]])


@bad("The mask's size is not the camera's", where="masks/cam1.png", got="158 x 200", fix="calibrated image")
def mask_of_another_size(request: Request) -> None:
    crop(request.capture / "masks" / "cam1.png")


@bad("The mask is empty", where="masks/cam5.png", got="no pixel above 0", fix="draw the mask")
def mask_empty(request: Request) -> None:
    assert cv2.imwrite(str(request.capture / "masks" / "cam5.png"), np.zeros((200, 160), np.uint8))


@bad("The label map's size is not the camera's", where="segmentation/cam7.png", got="158 x 200", fix="calibrated")
def labels_of_another_size(request: Request) -> None:
    crop(request.capture / "segmentation" / "cam7.png")


@bad("A label index has no name", where="segmentation/cam0.png", got="index", fix="classes of capture.toml")
def label_without_a_name(request: Request) -> None:
    edit(request.capture / "capture.toml", ', "neck_other"', "")


@bad("The landmark file is malformed", where="landmarks/cam1.json", got="(68, 2)", fix="confidence")
def landmarks_malformed(request: Request) -> None:
    path = request.capture / "landmarks" / "cam1.json"
    path.write_text(json.dumps({"68": [row[:2] for row in json.loads(path.read_text())["68"]]}))


@bad('The landmark scheme "68" has another length', where="landmarks", got="60", fix="another name")
def landmarks_of_another_count(request: Request) -> None:
    for path in (request.capture / "landmarks").iterdir():
        path.write_text(json.dumps({"68": json.loads(path.read_text())["68"][:60]}))


@bad("The scan cannot be used", where="scan.ply", got="", fix="PLY")
def scan_damaged(request: Request) -> None:
    (request.capture / "scan.ply").write_text("ply\nthis is none\n")


# The model


@bad("The head model is missing", where="tiny_gnm.npz", got="no such file", fix="gnmreg model fetch")
def model_missing(request: Request) -> None:
    request.model.unlink()


@bad("The head model cannot be read", where="tiny_gnm.npz", got="", fix="gnmreg model fetch")
def model_truncated(request: Request) -> None:
    content = request.model.read_bytes()
    request.model.write_bytes(content[: len(content) // 2])


@bad("field 'skinning_weights' is missing", where="tiny_gnm.npz", got="22 of them", fix="gnmreg model fetch")
def model_without_a_field(request: Request) -> None:
    request.change_model(skinning_weights=None)


@bad("expression_basis", where="tiny_gnm.npz", got="(7, 1162, 3)", fix="gnmreg model fetch")
def model_with_a_wrong_shape(request: Request) -> None:
    request.change_model(expression_basis=np.zeros((7, 1162, 3), np.float16))


@bad("vertex_identity_basis", where="tiny_gnm.npz", got="1 NaN", fix="gnmreg model fetch")
def model_with_nan(request: Request) -> None:
    with np.load(request.model) as archive:
        basis = archive["vertex_identity_basis"]
    basis[2, 100, 1] = np.nan
    request.change_model(vertex_identity_basis=basis)


class Payload:
    """Unpickling it creates a folder."""

    def __init__(self, path: Path):
        self._path = path

    def __reduce__(self):
        return os.mkdir, (str(self._path),)


@bad("'variant' cannot be read", where="tiny_gnm.npz", got="Python objects", fix="gnmreg model fetch")
def model_with_a_pickle(request: Request) -> None:
    unpickled = request.folder / "unpickled"
    pickle.loads(pickle.dumps(Payload(unpickled)))
    assert unpickled.exists()  # the payload works
    unpickled.rmdir()
    array = np.empty(1, object)
    array[0] = Payload(unpickled)
    request.change_model(variant=array)
    with zipfile.ZipFile(request.model) as archive:
        assert str(unpickled).encode() in archive.read("variant.npy")


@bad("no vertex group 'skin'", where="vertex_group_names", got="hockey_mask", fix="official vertex groups")
def model_without_a_group(request: Request) -> None:
    with np.load(request.model) as archive:
        names = archive["vertex_group_names"]
    names[names == "skin"] = "hide"
    request.change_model(vertex_group_names=names)


@bad("not a manifold", where="edge between vertices", got="4 triangles", fix="remove the duplicate")
def model_that_is_no_manifold(request: Request) -> None:
    data = gnm_npz.read(request.model)
    request.change_model(
        triangles=np.concatenate([data.triangles, data.triangles[:2]]),
        triangle_uvs=np.concatenate([data.triangle_uvs, data.triangle_uvs[:2]]),
    )


@bad("scheme has a wrong row", where="head_sparse_68.txt", got="in row 3", fix="one landmark a row")
def scheme_beside_the_model_malformed(request: Request) -> None:
    path = request.folder / "head_sparse_68.txt"
    lines = path.read_text().splitlines()
    path.write_text("\n".join([*lines[:3], "1 0.5 2", *lines[4:]]))


@bad("scheme has a wrong vertex index", where="mine.txt", got="in row 1", fix="one landmark a row")
def scheme_given_is_not_the_model_s(request: Request) -> None:
    path = request.folder / "mine.txt"
    path.write_text("0 1 1 0 2 0\n0 1 1 0 20000 0\n")
    request.options["landmark_files"] = {"68": path}


@bad("another length than the model's scheme", where="scheme mouth", got="20", fix="--landmarks mouth=FILE")
def scheme_given_has_another_count(request: Request) -> None:
    path = request.folder / "mine.txt"
    path.write_text("0 1 1 0 2 0\n" * 12)
    for file in (request.capture / "landmarks").iterdir():
        file.write_text(json.dumps({"mouth": json.loads(file.read_text())["68"][48:]}))
    request.options["landmark_files"] = {"mouth": path}


# The neutral


@bad("The registration cannot be read", where="neutral/manifest.json", got="no such file", fix="gnmreg register")
def neutral_missing(request: Request) -> None:
    request.options["neutral"] = request.folder / "neutral"


@bad("The registration was changed", where="neutral", got="", fix="register again")
def neutral_changed(request: Request) -> None:
    request.options["neutral"] = write_neutral(request.folder / "neutral", gnm_npz.read(request.model))
    path = request.folder / "neutral" / "registration.npz"
    with np.load(path) as archive:
        arrays = {name: archive[name] for name in archive.files}
    arrays["identity"][0] += 1
    np.savez(path, **arrays)


@bad("The registration cannot be read", where="registration.npz", got="", fix="register again")
def neutral_truncated(request: Request) -> None:
    request.options["neutral"] = write_neutral(request.folder / "neutral", gnm_npz.read(request.model))
    path = request.folder / "neutral" / "registration.npz"
    path.write_bytes(path.read_bytes()[:5000])


@bad("registered with another model", where="neutral", got="other triangles", fix="register the neutral with this")
def neutral_of_another_topology(request: Request) -> None:
    data = gnm_npz.read(request.model)
    request.options["neutral"] = write_neutral(request.folder / "neutral", data)
    request.change_model(triangles=data.triangles[::-1], triangle_uvs=data.triangle_uvs[::-1])


@bad("registered with another model", where="neutral", got="(6, 7, 1163)", fix="register the neutral with this")
def neutral_of_another_basis(request: Request) -> None:
    data = gnm_npz.read(request.model)
    request.options["neutral"] = write_neutral(request.folder / "neutral", data)
    request.change_model(
        vertex_identity_basis=data.vertex_identity_basis[:5],
        joint_identity_basis=data.joint_identity_basis[:5],
        identity_names=data.identity_names[:5],
    )


@bad("The neutral shows another subject", where="neutral", got="somebody", fix="this subject's neutral")
def neutral_of_another_subject(request: Request) -> None:
    data = gnm_npz.read(request.model)
    folder = write_neutral(request.folder / "neutral", data)
    save_registration(replace(load_registration(folder), figures={"subject": "somebody"}), folder)
    request.options["neutral"] = folder


def write_neutral(out: Path, data: gnm_npz.GNMData) -> Path:
    """A registration folder of the model's template."""
    model = GNM(data)
    rest = model.neutral()
    vertices = model(rest).numpy()
    registration = Registration(
        status="converged",
        reason="at rest",
        **{name: value.numpy() for name, value in vars(rest).items()},
        offsets=np.zeros_like(vertices),
        vertices=vertices,
        triangles=data.triangles,
        confidence=np.ones(len(vertices), np.float32),
        texture=np.full((8, 8, 3), 0.5, np.float32),
        corner_uvs=texture_atlas(data),
    )
    return save_registration(registration, out)


# The rest of the call


@bad("The output folder cannot be used", where="out", got="holds thesis.txt", fix="another output folder")
def out_is_someone_else_s(request: Request) -> None:
    request.out.mkdir()
    (request.out / "thesis.txt").write_text("years of work")


@bad("The output folder cannot be used", where="out", got="also notes.txt", fix="move these files elsewhere")
def out_is_ours_and_holds_more(request: Request) -> None:
    write_neutral(request.out, gnm_npz.read(request.model))
    (request.out / "notes.txt").write_text("what I saw")


@bad("The output folder cannot be used", where="out", got="a file", fix="another output folder")
def out_is_a_file(request: Request) -> None:
    request.out.write_text("here")


@bad("The output folder cannot be used", where="capture", got="capture.toml", fix="another output folder")
def out_is_the_capture(request: Request) -> None:
    request.out = request.capture


@bad("There is no such recipe", where="recipe", got="drafty", fix="choose one")
def recipe_unknown(request: Request) -> None:
    request.options["recipe"] = "drafty"


@bad("Too few views", where="views", got="1", fix="at least two")
def one_view_asked_for(request: Request) -> None:
    request.options["views"] = 1


@bad("The head cannot be located", where="capture", got="no masks", fix="masks")
def neither_landmarks_nor_masks(request: Request) -> None:
    for part in ("landmarks", "masks", "segmentation"):
        shutil.rmtree(request.capture / part)
