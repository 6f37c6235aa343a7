"""Every reader of a file, given a valid file that was mutated: it reads it, or refuses it with an `InputError`.

The environment's MUTATIONS is the number of mutations of each kind and file; they are the same in every run.
"""

import io
import json
import os
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import OpenEXR
import pytest
import trimesh
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from coregister.anatomy.tongue_keypoints import read_recording
from coregister.evaluate.face_data import FaceSample
from coregister.evaluate.face_protocol import SampleResult
from coregister.sampler.keras_decoder import read_decoder
from coregister.sampler.storage import read_sampler
from registration.capture import pixels
from registration.capture.colmap import read_cameras, read_points
from registration.capture.landmark_files import read_landmarks
from registration.capture.scan import read_scan, read_truth
from registration.capture.settings import read_settings
from registration.cranium import auxiliary_model
from registration.errors import InputError
from registration.linear_models import registry as linear_models
from registration.model import gnm_npz, gnmw
from registration.model.landmarks import read_scheme
from registration.storage.registration_folder import load_registration, read_manifest
from registration.topology_map import file as topology_map
from registration.types import Camera, View
from tests.conftest import FIXTURES
from tests.coregister.sampler.hdf5_decoder import write_decoder
from tests.coregister.sampler.made import write_sampler
from tests.fixtures.malformed.sandbox import make_templates
from tests.registration.cranium.smooth_heads import auxiliary_model as auxiliary
from tests.registration.cranium.smooth_heads import tiny
from tests.registration.topology_map.small_map import small_map
from tests.workflows.records.plan import PLAN
from workflows.gate.decisions import DecisionLog, Ruling, read_log, read_public_key
from workflows.gate.rules import GateThresholds
from workflows.records.coregistration import CoregistrationPlan, CoregistrationState, initial_state
from workflows.records.dataset import DatasetRecord
from workflows.records.dataset_import import DatasetImportRecord, ImportRow
from workflows.records.decisions import read_decisions
from workflows.records.face_results import read_result, write_result
from workflows.records.face_samples import read_samples, write_samples
from workflows.records.held_out import read_held_out
from workflows.records.step_results import GateResult
from workflows.records.store import Store
from workflows.records.subject import SubjectRecord

QUICK = settings(
    max_examples=int(os.environ.get("MUTATIONS", "40")),
    derandomize=True,
    deadline=None,
    database=None,
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
)
SIZE = (120, 160)
EXTREMES = (0, 1, 2**15, 2**31 - 1, 2**31, 2**32 - 1)


@pytest.fixture(scope="module")
def valid(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = make_templates(tmp_path_factory.mktemp("mutated") / "valid")
    initial_state(PLAN).write(folder / "coregistration.json")
    PLAN.write(folder / "plan.json")
    write_sampler(folder / "sampler")
    write_decoder(folder / "decoder.h5", (84, 8, 12))
    recording = ImportRow(folder="ann/smile", source="017/EXP-1", format="nersemble", frame=3, status="imported")
    origin = DatasetImportRecord(source=Path("/data"), frames=(3,), neutral="EXP-1", unit=None, rows=(recording,))
    origin.write(folder / "import.json")
    row = {"dataset": "d" * 64, "region": "mouth", "component": 0, "action": "drop", "reason": ""}
    (folder / "decisions.jsonl").write_text(f"{json.dumps(row)}\n" * 2)
    write_gate_files(folder)
    picture = np.random.default_rng(0).integers(0, 255, (SIZE[1], SIZE[0], 3), np.uint8)
    for suffix in ("jpg", "tif", "bmp", "webp"):
        cv2.imwrite(str(folder / f"picture.{suffix}"), cv2.GaussianBlur(picture, (0, 0), 4))
    depths = np.full((SIZE[1], SIZE[0]), 0.5, np.float32)
    (folder / "cam1.geometric.bin").write_bytes(f"{SIZE[0]}&{SIZE[1]}&1&".encode("ascii") + depths.tobytes())
    np.save(folder / "cam1.npy", depths)
    write_face_files(folder)
    header_exr = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    OpenEXR.File(header_exr, {"Z": depths}).write(str(folder / "cam1.exr"))
    rng = np.random.default_rng(1)
    rows = "".join(f"{x:.4f} {y:.4f} {z:.4f}\n" for x, y, z in rng.normal(size=(20, 3)))
    header = "ply\nformat ascii 1.0\nelement vertex 20\nproperty float x\nproperty float y\nproperty float z\n"
    faces = "element face 2\nproperty list uchar int vertex_indices\nend_header\n"
    gnmw.write(gnmw.web_model(gnm_npz.read(folder / "tiny_gnm.npz")), folder / "tiny_gnm.gnmw")
    auxiliary_model.write(auxiliary(), folder / "head_cranium.npz")
    topology_map.write(small_map(), folder / "map.npz")
    (folder / "text.ply").write_text(header + faces + rows + "3 0 1 2\n4 3 4 5 6\n")
    ball = trimesh.creation.icosphere(subdivisions=1)
    for suffix in ("obj", "glb"):
        ball.export(folder / f"ball.{suffix}")
    return folder


def write_gate_files(folder: Path) -> None:
    """The gate's record of a round, its thresholds, and a log of two decisions."""
    ruling = {"content_id": "c1", "name": "ann/smile", "reason": "", "who": "eve", "thresholds": "t", "verdict": "look"}
    log = DecisionLog.of_farm(folder)
    for decision in ("accept", "undo"):
        log.append(Ruling(decision=decision, **ruling))
    GateThresholds().write(folder / "thresholds.json")
    verdicts = {"accept": 1, "look": 0, "reject": 0}
    shared = {"policy": "auto", "thresholds": "t", "thresholds_name": "default", "accepted_id": "s", "waiting": 0}
    GateResult(**shared, verdicts=verdicts, accepted=1, left_out={"ann/jaw": "blurred"}).write(folder / "gate.json")


def write_face_files(folder: Path) -> None:
    """A registered scan, and the result of comparing a model with it."""
    vertices = np.random.default_rng(2).normal(size=(6, 3))
    triangles = np.array([[0, 1, 2], [3, 4, 5]])
    meshes = {"vertices": vertices, "scan": vertices + 1, "scan_triangles": triangles}
    sample = FaceSample(name="a", subject="b", category="neutral", tags={"age": 3}, **meshes)
    write_samples((sample,), triangles, folder / "registered_scans.npz")
    result = SampleResult(
        distances_mm={"stage1": np.ones(4, np.float32)},
        rms_mm={"stage1": 1.0},
        members=np.ones((2, 4), bool),
        nearest=np.arange(4),
        curves_mm={"identity": np.ones(2)},
        converged={"stage1": True},
        largest=1.0,
        left_out=0,
    )
    write_result(result, "key", folder / "face_result.npz")


def _camera() -> Camera:
    K = np.array([[200.0, 0, 60], [0, 200, 80], [0, 0, 1]])
    return Camera(width_px=SIZE[0], height_px=SIZE[1], intrinsics=K, T_cam_world=np.eye(4))


def _view(depth: Path) -> View:
    return View(name="cam1", camera=_camera(), image=depth, depth=depth, depth_unit_m=1e-3)


CLASSES = ("background", "right", "left")
Reader = Callable[[Path], object]
READERS: dict[str, tuple[str, Reader]] = {  # name -> the file that is mutated, its reader
    "settings": ("capture/capture.toml", read_settings),
    "cameras.txt": ("capture/sparse/cameras.txt", lambda file: read_cameras(file.parent)),
    "images.txt": ("capture/sparse/images.txt", lambda file: read_cameras(file.parent)),
    "points3D.txt": ("capture/sparse/points3D.txt", lambda file: read_points(file.parent)),
    "cameras.bin": ("binary/sparse/cameras.bin", lambda file: read_cameras(file.parent)),
    "images.bin": ("binary/sparse/images.bin", lambda file: read_cameras(file.parent)),
    "points3D.bin": ("binary/sparse/points3D.bin", lambda file: read_points(file.parent)),
    "landmarks": ("capture/landmarks/cam1.json", read_landmarks),
    "image": ("capture/images/cam1.png", lambda file: pixels.read_image(file, _camera())),
    "mask": ("capture/masks/cam1.png", lambda file: pixels.read_mask(file, _camera())),
    "normals": ("capture/normals/cam1.png", lambda file: pixels.read_normals(file, _camera())),
    "labels": ("capture/segmentation/cam1.png", lambda file: pixels.read_labels(file, _camera(), CLASSES)),
    "dense depths": ("cam1.geometric.bin", lambda file: pixels.read_depth(_view(file))),
    "depths": ("cam1.npy", lambda file: pixels.read_depth(_view(file))),
    "EXR depths": ("cam1.exr", lambda file: pixels.read_depth(_view(file))),
    **{
        suffix: (f"picture.{suffix}", lambda file: pixels.read_image(file, _camera()))
        for suffix in ("jpg", "tif", "bmp", "webp")
    },
    "scan": ("capture/scan.ply", read_scan),
    "text scan": ("text.ply", read_scan),
    "OBJ scan": ("ball.obj", read_scan),
    "GLB scan": ("ball.glb", read_scan),
    "truth": ("capture/ground_truth.npz", read_truth),
    "model": ("tiny_gnm.npz", gnm_npz.read),
    "model for the web": ("tiny_gnm.gnmw", gnmw.read),
    "auxiliary model": ("head_cranium.npz", lambda file: auxiliary_model.read(file, tiny())),
    **{
        f"model {name}": (f"others/{name}", linear_models.read)
        for name in ("plain.npz", "flame.pkl", "flame.npz", "basel.h5", "lsfm.mat", "lsfm_7_3.mat")
    },
    "model ict": ("others/ict/identity001.obj", lambda file: linear_models.read(file.parent)),
    "topology map": ("map.npz", topology_map.read),
    "scheme": ("head_sparse_68.txt", lambda file: read_scheme(file, np.zeros((3000, 3)))),
    "manifest": ("registration/manifest.json", lambda file: read_manifest(file.parent)),
    "history": ("registration/history.json", lambda file: load_registration(file.parent)),
    "arrays": ("registration/registration.npz", lambda file: load_registration(file.parent)),
    "texture": ("registration/texture.png", lambda file: load_registration(file.parent)),
    "subject": ("run/ann/subject.json", SubjectRecord.read),
    "dataset": ("dataset/dataset.json", DatasetRecord.read),
    "dataset import": ("import.json", DatasetImportRecord.read),
    "decisions": ("decisions.jsonl", lambda file: read_decisions(file, "d" * 64)),
    "plan": ("plan.json", CoregistrationPlan.read),
    "state": ("coregistration.json", CoregistrationState.read),
    "gate": ("gate.json", GateResult.read),
    "thresholds": ("thresholds.json", GateThresholds.read),
    "gate's decisions": ("gate/decisions.jsonl", read_log),
    "gate's key": ("gate/key.pub", read_public_key),
    "held out": ("held_out.npz", read_held_out),
    "registered scans": ("registered_scans.npz", read_samples),
    "result of a sample": ("face_result.npz", lambda file: read_result(file, "key")),
    "tongue": ("tongue.csv", read_recording),
    "tongue arrays": ("tongue.npz", read_recording),
    "sampler": ("sampler/sampler.json", lambda file: read_sampler(file.parent)),
    "sampler's arrays": ("sampler/sampler.safetensors", lambda file: read_sampler(file.parent)),
    "decoder": ("decoder.h5", read_decoder),
    "artifact": ("store/run/a/b/artifact.json", lambda file: Store(file.parents[3]).find("run/a/b")),
}
place = st.floats(0, 1, exclude_max=True)
edit = st.one_of(
    st.tuples(st.just("set"), place, st.binary(min_size=1, max_size=8)),
    st.tuples(st.just("insert"), place, st.binary(min_size=1, max_size=40)),
    st.tuples(st.just("delete"), place, st.integers(1, 200)),
    st.tuples(st.just("repeat"), place, st.integers(1, 200)),
    st.tuples(st.just("cut"), place, st.none()),
    st.tuples(st.just("number"), place, st.sampled_from(EXTREMES)),
    st.tuples(st.just("flip"), place, st.integers(0, 7)),
)


def mutated(content: bytes, edits: list[tuple[str, float, Any]]) -> bytes:
    data = bytearray(content)
    for kind, where, value in edits:
        at = int(where * len(data))
        if kind == "set":
            data[at : at + len(value)] = value
        elif kind == "insert":
            data[at:at] = value
        elif kind == "delete":
            del data[at : at + value]
        elif kind == "repeat":
            data[at:at] = data[at : at + value]
        elif kind == "cut":
            del data[at:]
        elif kind == "number":
            data[at : at + 4] = struct.pack("<I", value)
        elif data:
            data[at] ^= 1 << value
    return bytes(data)


def read_or_refuse(reader: Reader, file: Path, content: bytes) -> None:
    """Read a file with this content, and restore it; any exception but InputError is raised."""
    original = file.read_bytes()
    file.write_bytes(content)
    try:
        reader(file)
    except InputError as error:
        assert str(error) and error.got and error.expected
    finally:
        file.write_bytes(original)


@pytest.mark.parametrize("name", READERS)
@given(edits=st.lists(edit, min_size=1, max_size=4))
@QUICK
def test_mutated_bytes_are_read_or_refused(valid, name, edits):
    path, reader = READERS[name]
    read_or_refuse(reader, valid / path, mutated((valid / path).read_bytes(), edits))


@pytest.mark.parametrize("name", READERS)
def test_the_valid_file_is_read(valid, name):
    path, reader = READERS[name]
    reader(valid / path)


numbers = st.one_of(st.integers(), st.floats(), st.sampled_from([2**63, -(2**63), 10**30, 1e308, -1]))
values = st.recursive(
    st.one_of(st.none(), st.booleans(), numbers, st.text(max_size=8)),
    lambda inner: st.one_of(st.lists(inner, max_size=4), st.dictionaries(st.text(max_size=6), inner, max_size=4)),
    max_leaves=8,
)


def nodes(value: Any, path: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    """The paths of all values within a JSON value, but for its own."""
    items = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    return [found for key, item in items for found in ((*path, key), *nodes(item, (*path, key)))]


def replaced(value: Any, path: tuple[Any, ...], new: Any) -> Any:
    target = value
    for key in path[:-1]:
        target = target[key]
    target[path[-1]] = new
    return value


RECORDS = ("landmarks", "manifest", "history", "subject", "dataset", "plan", "state", "artifact")


@pytest.mark.parametrize("name", RECORDS)
@given(where=place, new=values)
@QUICK
def test_other_values_in_json_are_read_or_refused(valid, name, where, new):
    path, reader = READERS[name]
    value = json.loads((valid / path).read_bytes())
    paths = nodes(value)
    changed = replaced(value, paths[int(where * len(paths))], new)
    read_or_refuse(reader, valid / path, json.dumps(changed).encode())


DTYPES = ("<f4", ">f8", "<f2", "<i8", "|u1", "|b1", "<U3", "<c8", "<M8[s]")


@pytest.mark.parametrize("name", ["truth", "arrays", "held out", "model", "tongue arrays", "topology map"])
@given(
    where=place, dtype=st.sampled_from(DTYPES), shape=st.lists(st.integers(0, 5), max_size=4), fill=st.integers(0, 9)
)
@QUICK
def test_other_arrays_in_npz_are_read_or_refused(valid, name, where, dtype, shape, fill):
    path, reader = READERS[name]
    with np.load(valid / path) as archive:
        arrays = {field: archive[field] for field in archive.files}
    field = list(arrays)[int(where * len(arrays))]
    arrays[field] = np.full(shape, 3).astype(dtype)
    stream = io.BytesIO()
    np.savez(stream, **arrays)
    read_or_refuse(reader, valid / path, stream.getvalue())


def test_the_readers_include_all_records():
    """A new record must be mutated here too."""
    from registration.storage.records import Record

    known = {
        "RegistrationManifest",
        "SubjectRecord",
        "DatasetRecord",
        "DecisionEntry",
        "Artifact",
        "DatasetImportRecord",
    }
    known |= {"CoregistrationPlan", "CoregistrationState", "GateResult"}
    stored = {cls.__name__ for cls in Record.__subclasses__() if cls.__module__.startswith("workflows.records")}
    assert stored - known <= {"StepResult", "StabilizeResult"}  # of steps, written and read in one run
    assert FIXTURES.is_dir()
