"""Malicious captures, models, stores and jobs: each is refused with a clear error, and the child process survives.

As in a worker, jobs are checked against the table of steps and the roots, then sent to the child process.
"""

import asyncio
import io
import json
import os
import pickle
import shutil
import struct
import zipfile
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from registration.errors import InputError
from tests.conftest import FIXTURES
from tests.registration.capture import small
from workflows.engine.child import StepProcess
from workflows.engine.jobs import MAX_BYTES, validate_arguments
from workflows.ids import resolve_roots
from workflows.records.store import MANIFEST, Store
from workflows.steps.table import STEPS

MODEL = FIXTURES / "tiny_gnm.npz"


class Trap:
    """Unpickling an instance creates a file."""

    def __init__(self, file: Path) -> None:
        self.file = file

    def __reduce__(self) -> tuple[Any, ...]:
        return os.mknod, (str(self.file),)


@pytest.fixture(scope="module")
def process() -> Iterator[StepProcess]:
    process = StepProcess(modules=("workflows.steps.register",))
    process.warm()
    yield process
    process.kill()


@pytest.fixture(scope="module")
def good(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return small.make(tmp_path_factory.mktemp("good") / "capture")


@pytest.fixture
def root(good: Path, tmp_path: Path) -> Path:
    """A root folder with a capture and a model; a secret file is outside of it."""
    (tmp_path / "secret.txt").write_text("secret")
    root = tmp_path / "root"
    shutil.copytree(good, root / "capture")
    shutil.copy(MODEL, root / "model.npz")
    return root


def job(root: Path, **changed: Any) -> dict[str, Any]:
    arguments = {"capture": f"{root}/capture", "model": f"{root}/model.npz", "store": f"{root}/store", "key": "k"}
    return {"step": "register stored", "arguments": {**arguments, **changed}}


def first_image(root: Path) -> Path:
    return sorted((root / "capture" / "images").rglob("*.png"))[0]


def link_image(root: Path) -> None:
    first = first_image(root)
    shutil.move(first, root.parent / "image.png")
    first.symlink_to(root.parent / "image.png")


def link_scan(root: Path) -> None:
    (root / "capture" / "scan.ply").unlink()
    (root / "capture" / "scan.ply").symlink_to(root.parent / "secret.txt")


def link_folder(root: Path) -> None:
    shutil.move(root / "capture" / "sparse", root.parent / "sparse")
    (root / "capture" / "sparse").symlink_to(root.parent / "sparse")


def name_outside(name: str) -> Callable[[Path], None]:
    def rename(root: Path) -> None:
        file = root / "capture" / "sparse" / "images.txt"
        old = first_image(root).relative_to(root / "capture" / "images").as_posix()
        assert old in file.read_text()
        file.write_text(file.read_text().replace(old, name))

    return rename


def bomb_image(root: Path) -> None:
    """A PNG of a few bytes that declares 60,000 x 60,000 pixels."""
    body = b"IHDR" + struct.pack(">IIBBBBB", 60_000, 60_000, 8, 2, 0, 0, 0)
    chunk = struct.pack(">I", 13) + body + struct.pack(">I", zlib.crc32(body))
    first_image(root).write_bytes(b"\x89PNG\r\n\x1a\n" + chunk + b"\x00\x00\x00\x00IEND\xaeB`\x82")


def pickle_truth(root: Path) -> None:
    trap = np.array([Trap(root.parent / "sprung")], object)
    np.savez(root / "capture" / "ground_truth.npz", vertices=trap)


def pickle_model(root: Path) -> None:
    with np.load(MODEL) as archive:
        fields = {name: archive[name] for name in archive.files}
    fields[next(iter(fields))] = np.array([Trap(root.parent / "sprung")], object)
    np.savez(root / "model.npz", **fields)


def raw_pickle(root: Path) -> None:
    (root / "model.npz").write_bytes(pickle.dumps(Trap(root.parent / "sprung")))


def bomb_truth(root: Path) -> None:
    """1.1 GB of zeros in 5 MB."""
    head = io.BytesIO()
    np.lib.format.write_array_header_1_0(head, {"descr": "<f8", "fortran_order": False, "shape": (46_000_000, 3)})
    with zipfile.ZipFile(root / "capture" / "ground_truth.npz", "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        with archive.open("vertices.npy", "w", force_zip64=True) as member:
            member.write(head.getvalue())
            for _ in range(69):
                member.write(bytes(16_000_000))


def deep_landmarks(root: Path) -> None:
    file = sorted((root / "capture" / "landmarks").rglob("*.json"))[0]
    file.write_text("[" * 100_000)


def endless_toml(root: Path) -> None:
    (root / "capture" / "capture.toml").unlink()
    os.symlink("/dev/zero", root / "capture" / "capture.toml")


ATTACKS: dict[str, tuple[Callable[[Path], None], str]] = {
    "an image that is a link out": (link_image, "link leads out"),
    "a scan that is a link out": (link_scan, "link leads out"),
    "a folder that is a link out": (link_folder, "link leads out"),
    "a device for a file": (endless_toml, "link leads out"),
    "an image named ../..": (name_outside("../../../secret.png"), "image name cannot be used"),
    "an image named from /": (name_outside("/etc/secret.png"), "image name cannot be used"),
    "an image bomb": (bomb_image, "too many pixels"),
    "a truth that is a pickle": (pickle_truth, "ground truth's field 'vertices' cannot be read"),
    "a truth that is a bomb": (bomb_truth, "ground truth cannot be read"),
    "a model with a pickle": (pickle_model, "head model"),
    "a model that is a pickle": (raw_pickle, "head model"),
    "landmarks without a bottom": (deep_landmarks, "landmark file is malformed"),
}


@pytest.mark.parametrize("name", ATTACKS)
def test_a_malicious_capture_or_model_is_refused_and_the_child_survives(
    process: StepProcess, root: Path, name: str
) -> None:
    damage, words = ATTACKS[name]
    damage(root)
    pid = process.warm()
    step, arguments = validate_arguments(job(root), STEPS, resolve_roots((root,)))
    outcome = asyncio.run(process.run(step.function, arguments, log=root.parent / "log", timeout_s=120.0))
    assert outcome["status"] == "bad input" and words in outcome["reason"], outcome
    assert not (root.parent / "sprung").exists()
    assert not [path for path in (root / "store").rglob("*") if path.is_file()]
    assert process.warm() == pid


@pytest.mark.parametrize(
    "changed",
    [
        {"capture": "/etc"},
        {"capture": "file:///etc"},
        {"capture": "s3://somebody/else"},
        {"capture": "http://169.254.169.254/latest/meta-data"},
        {"model": "{root}/../secret.txt"},
        {"store": "{root}/out/link"},
        {"store": "s3://key:password@bucket/x"},
        {"capture": "x" * MAX_BYTES},
    ],
)
def test_a_location_outside_the_roots_never_reaches_the_child(root: Path, changed: dict[str, str]) -> None:
    (root / "out").mkdir()
    (root / "out" / "link").symlink_to(root.parent)
    changed = {key: value.replace("{root}", str(root)) for key, value in changed.items()}
    with pytest.raises(InputError) as refused:
        validate_arguments(job(root, **changed), STEPS, resolve_roots((root,)))
    assert "password" not in str(refused.value)


def test_an_unknown_step_never_reaches_the_child(root: Path) -> None:
    for step in ("os:system", "workflows.steps.register:register_stored", "__import__", ""):
        with pytest.raises(InputError, match="refused"):
            validate_arguments({"step": step, "arguments": {}}, STEPS, resolve_roots((root,)))


def test_a_key_outside_the_store_is_refused(tmp_path: Path) -> None:
    for key in ("../x", "/etc/x", "a/../../x", ".hidden", ""):
        with pytest.raises(InputError):
            Store(tmp_path / "store").produce(key, input_hash="w", make=lambda folder: {})
    assert not (tmp_path / "store").exists()


def test_verify_reports_a_manifest_with_a_wrong_checksum(tmp_path: Path) -> None:
    store = Store(tmp_path)
    artifact = store.produce("k", input_hash="w", make=lambda folder: (folder / "f").write_text("abc") and {})
    value = json.loads((tmp_path / "k" / MANIFEST).read_text())
    value["files"]["f"]["sha256"] = "0" * 64
    (tmp_path / "k" / MANIFEST).write_text(json.dumps(value))
    assert store.verify().unreadable and artifact.files["f"].bytes == 3
