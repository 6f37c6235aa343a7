"""Registration <-> folder: lossless, atomic, and without changing other files."""

import json
import os
import re
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import trimesh

from registration.errors import InputError
from registration.storage import files, registration_folder
from registration.storage.hashing import hash_capture, hash_file, input_hash
from registration.storage.registration_folder import (
    check_output_folder,
    find_existing,
    load_registration,
    save_registration,
    update_figures,
)
from registration.types import Camera, Capture, Registration, View


def a_registration(seed: int = 0, **changes) -> Registration:
    """A tetrahedron with one uv seam per face: 4 vertices, 12 uv corners."""
    rng = np.random.default_rng(seed)
    triangles = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]], np.int32)
    fields = dict(
        status="converged",
        reason="vertex motion 0.01 mm",
        identity=rng.normal(size=5),
        expression=rng.normal(size=7),
        rotations=rng.normal(size=(4, 3)),
        translation=rng.normal(size=3),
        scale=np.array(1.02),
        offsets=rng.normal(size=(4, 3)) * 1e-3,
        vertices=np.array([[0, 0, 0], [0.1, 0, 0], [0, 0.1, 0], [0, 0, 0.1]]) + rng.normal(size=(4, 3)) * 1e-3,
        confidence=rng.random(4),
        texture=rng.random((16, 16, 3)),
        corner_uvs=rng.random((4, 3, 2)),
    )
    fields = {k: np.asarray(v, np.float32) if isinstance(v, np.ndarray) else v for k, v in fields.items()}
    return Registration(
        **{
            **fields,
            "triangles": triangles,
            "landmarks": {"68": rng.random((68, 3)).astype(np.float32)},
            "seconds": {"rigid": 1.5},
            "history": {"rigid": {"landmarks": [3.0, 1.0, float("nan")]}},
            "figures": {"scan_to_mesh": {"face": {"mean_mm": 0.1}}},
            "config": {"recipe": "draft", "steps": 3},
            "inputs": {"capture": "ab", "model": "cd"},
            **changes,
        }
    )


def test_round_trip(tmp_path):
    given = a_registration()
    save_registration(given, tmp_path / "r", report_html="<p>hi</p>")
    got = load_registration(tmp_path / "r")
    for name in registration_folder.AXES:
        np.testing.assert_array_equal(getattr(got, name), getattr(given, name), err_msg=name)
    np.testing.assert_array_equal(got.landmarks["68"], given.landmarks["68"])
    # 16 bit sRGB: half a step of 1/65535, times the curve's steepest slope of 2.4.
    np.testing.assert_allclose(got.texture, given.texture, atol=2e-5)
    np.testing.assert_array_equal(got.history["rigid"]["landmarks"], [3.0, 1.0, np.nan])
    for name in ("status", "reason", "seconds", "figures", "config", "inputs"):
        assert getattr(got, name) == getattr(given, name), name
    assert sorted(p.name for p in (tmp_path / "r").iterdir()) == sorted(registration_folder.FILES)
    assert [p.name for p in tmp_path.iterdir()] == ["r"]


def test_saving_what_was_loaded_gives_the_same_content(tmp_path):
    save_registration(a_registration(), tmp_path / "a")
    save_registration(load_registration(tmp_path / "a"), tmp_path / "b")
    a, b = (json.loads((tmp_path / n / "manifest.json").read_text()) for n in "ab")
    assert a["content_id"] == b["content_id"] and a["input_hash"] == b["input_hash"]
    save_registration(a_registration(seed=1), tmp_path / "c")
    assert json.loads((tmp_path / "c" / "manifest.json").read_text())["content_id"] != a["content_id"]


def test_meshes_keep_the_vertices(tmp_path):
    given = a_registration()
    save_registration(given, tmp_path / "r")
    ply = trimesh.load(tmp_path / "r" / "mesh.ply", process=False, maintain_order=True)
    np.testing.assert_array_equal(np.asarray(ply.vertices, np.float32), given.vertices)
    np.testing.assert_array_equal(ply.faces, given.triangles)
    lines = [line.split() for line in (tmp_path / "r" / "mesh.obj").read_text().splitlines()]
    uvs = np.array([line[1:] for line in lines if line[0] == "vt"], float)
    corners = np.array([[c.split("/") for c in line[1:]] for line in lines if line[0] == "f"], int) - 1
    assert sum(line[0] == "v" for line in lines) == 4
    np.testing.assert_array_equal(corners[..., 0], given.triangles)
    np.testing.assert_allclose(uvs[corners[..., 1]], given.corner_uvs, atol=1e-6)
    assert "map_Kd texture.png" in (tmp_path / "r" / "mesh.mtl").read_text()
    assert cv2.imread(str(tmp_path / "r" / "texture.png"), -1).dtype == np.uint16


def test_a_far_world_is_stored_with_its_digits(tmp_path):
    near = a_registration()
    shift = np.array([512345.25, 5403210.5, 412.125])
    far = replace(
        near,
        vertices=near.vertices + shift,
        translation=near.translation + shift,
        landmarks={"68": near.landmarks["68"] + shift},
    )
    got = load_registration(save_registration(far, tmp_path / "r"))
    for name in registration_folder.AXES:
        np.testing.assert_array_equal(getattr(got, name), getattr(far, name), err_msg=name)
    np.testing.assert_array_equal(got.landmarks["68"], far.landmarks["68"])
    assert got.offsets.dtype == np.float32 and got.vertices.dtype == np.float64
    mesh = trimesh.load(tmp_path / "r" / "mesh.ply", process=False, maintain_order=True)
    np.testing.assert_array_equal(mesh.vertices, far.vertices)
    lines = (tmp_path / "r" / "mesh.obj").read_text().splitlines()
    written = np.array([line.split()[1:] for line in lines if line.startswith("v ")], float)
    np.testing.assert_allclose(written, far.vertices, atol=1e-7)
    assert load_registration(save_registration(near, tmp_path / "n")).vertices.dtype == np.float32


def test_an_existing_registration_is_replaced_completely(tmp_path):
    save_registration(a_registration(0), tmp_path / "r", report_html="old")
    save_registration(a_registration(1), tmp_path / "r")
    np.testing.assert_array_equal(load_registration(tmp_path / "r").identity, a_registration(1).identity)
    assert not (tmp_path / "r" / "report.html").exists()
    assert [p.name for p in tmp_path.iterdir()] == ["r"]


def test_replacement_without_an_atomic_exchange(tmp_path, monkeypatch):
    monkeypatch.setattr(files.ctypes, "CDLL", lambda *a, **k: object())  # as on a system without renameat2
    save_registration(a_registration(0), tmp_path / "r")
    save_registration(a_registration(1), tmp_path / "r")
    np.testing.assert_array_equal(load_registration(tmp_path / "r").identity, a_registration(1).identity)
    assert [p.name for p in tmp_path.iterdir()] == ["r"]


@pytest.mark.parametrize("failing", ["write_obj", "exchange"])
def test_a_crash_while_writing_keeps_the_previous_result(tmp_path, monkeypatch, failing):
    save_registration(a_registration(0), tmp_path / "r")

    def crash(*_):
        raise OSError("disk full")

    monkeypatch.setattr(files if failing == "exchange" else registration_folder, failing, crash)
    with pytest.raises(OSError, match="disk full"):
        save_registration(a_registration(1), tmp_path / "r")
    np.testing.assert_array_equal(load_registration(tmp_path / "r").identity, a_registration(0).identity)
    assert [p.name for p in tmp_path.iterdir()] == ["r"]


def foreign_folder(root: Path) -> Path:
    (root / "out").mkdir()
    (root / "out" / "thesis.txt").write_text("precious")
    return root / "out"


def foreign_manifest(root: Path) -> Path:
    (root / "out").mkdir()
    (root / "out" / "manifest.json").write_text('{"kind": "browser extension"}')
    return root / "out"


def ours_with_a_guest(root: Path) -> Path:
    save_registration(a_registration(), root / "out")
    (root / "out" / "thesis.txt").write_text("precious")
    return root / "out"


def a_file(root: Path) -> Path:
    (root / "out").write_text("precious")
    return root / "out"


def below_a_file(root: Path) -> Path:
    (root / "file").write_text("precious")
    return root / "file" / "out"


@pytest.mark.parametrize("make", [foreign_folder, foreign_manifest, ours_with_a_guest, a_file, below_a_file])
def test_output_that_is_no_registration_is_refused_and_unchanged(tmp_path, make):
    out = make(tmp_path)
    before = {p: p.read_bytes() for p in tmp_path.rglob("*") if p.is_file()}
    with pytest.raises(InputError, match="output folder"):
        check_output_folder(out)
    with pytest.raises(InputError, match="output folder"):
        save_registration(a_registration(1), out)
    assert {p: p.read_bytes() for p in tmp_path.rglob("*") if p.is_file()} == before


def test_new_and_empty_folders_are_accepted(tmp_path):
    (tmp_path / "empty").mkdir()
    for out in (tmp_path / "empty", tmp_path / "a" / "b"):
        check_output_folder(out)
        save_registration(a_registration(), out)
        assert load_registration(out).status == "converged"


def rewritten(folder: Path, drop: str | None = None, **changes) -> None:
    with np.load(folder / "registration.npz") as archive:
        arrays = {name: archive[name] for name in archive.files if name != drop}
    np.savez(folder / "registration.npz", **{**arrays, **changes})


def rewrite_manifest(folder: Path, **changes) -> None:
    manifest = {**json.loads((folder / "manifest.json").read_text()), **changes}
    kept = {name: value for name, value in manifest.items() if value is not ...}
    (folder / "manifest.json").write_text(json.dumps(kept))


BROKEN = {
    "missing field": (lambda d: rewritten(d, drop="offsets"), "offsets"),
    "wrong length": (lambda d: rewritten(d, offsets=np.zeros((5, 3), np.float32)), r"vertices'[\s\S]*\(V=5, 3\)"),
    "wrong rank": (lambda d: rewritten(d, confidence=np.zeros((4, 1), np.float32)), "confidence"),
    "not finite": (lambda d: rewritten(d, expression=np.full(7, np.nan, np.float32)), "expression"),
    "pickle": (lambda d: rewritten(d, identity=np.array([print], object)), "identity"),
    "wrong type": (lambda d: rewritten(d, triangles=np.zeros((4, 3))), "triangles'[\\s\\S]*integer array"),
    "bad index": (lambda d: rewritten(d, triangles=np.full((4, 3), 9)), "triangles"),
    "changed array": (lambda d: rewritten(d, identity=np.zeros(5, np.float32)), "changed after"),
    "truncated archive": (lambda d: os.truncate(d / "registration.npz", 900), "registration.npz"),
    "truncated texture": (lambda d: os.truncate(d / "texture.png", 300), "texture.png|changed after"),
    "no texture": (lambda d: (d / "texture.png").unlink(), "texture.png"),
    "no manifest": (lambda d: (d / "manifest.json").unlink(), "manifest.json"),
    "broken manifest": (lambda d: (d / "manifest.json").write_text("{"), "manifest.json"),
    "newer schema": (lambda d: rewrite_manifest(d, schema=99), "schema"),
    "lost entry": (lambda d: rewrite_manifest(d, content_id=...), "content_id"),
}


@pytest.mark.parametrize("case", BROKEN)
def test_errors_name_the_defect_of_a_damaged_folder(tmp_path, case):
    save_registration(a_registration(), tmp_path / "r")
    expected_hash = input_hash(a_registration().inputs, a_registration().config)
    assert find_existing(tmp_path / "r", expected_hash) is not None
    breaks, message = BROKEN[case]
    breaks(tmp_path / "r")
    with pytest.raises(InputError) as caught:
        load_registration(tmp_path / "r")
    assert re.search(message, str(caught.value)), str(caught.value)
    assert find_existing(tmp_path / "r", expected_hash) is None


def test_non_finite_results_are_written_only_for_debugging(tmp_path):
    bad = a_registration(offsets=np.full((4, 3), np.nan, np.float32))
    with pytest.raises(ValueError, match="offsets"):
        save_registration(bad, tmp_path / "r")
    assert not list(tmp_path.iterdir())
    save_registration(replace(bad, status="failed", reason="diverged"), tmp_path / "r")
    with pytest.raises(InputError, match="offsets"):
        load_registration(tmp_path / "r")


def test_find_existing_depends_on_inputs_and_configuration(tmp_path):
    r = a_registration()
    save_registration(r, tmp_path / "r")
    assert find_existing(tmp_path / "r", input_hash(r.inputs, r.config)).reason == r.reason
    assert find_existing(tmp_path / "r", input_hash({**r.inputs, "model": "ee"}, r.config)) is None
    assert find_existing(tmp_path / "r", input_hash(r.inputs, {**r.config, "steps": 4})) is None
    assert find_existing(tmp_path / "nothing", "") is None


def test_update_figures_keeps_the_other_keys(tmp_path):
    save_registration(a_registration(), tmp_path / "r", report_html="old")
    update_figures(tmp_path / "r", {"drift": {"mean_mm": np.float32(0.5), "max_mm": float("inf")}}, report_html="new")
    got = load_registration(tmp_path / "r")
    assert got.figures == {"scan_to_mesh": {"face": {"mean_mm": 0.1}}, "drift": {"mean_mm": 0.5, "max_mm": None}}
    assert (tmp_path / "r" / "report.html").read_text() == "new"
    assert sorted(p.name for p in (tmp_path / "r").iterdir()) == sorted(registration_folder.FILES)


def a_capture(root: Path) -> Capture:
    (root / "images").mkdir(parents=True)
    views = []
    for k in range(2):
        image = root / "images" / f"{k}.png"
        image.write_bytes(bytes([k]) * 10)
        camera = Camera(width_px=4, height_px=4, intrinsics=np.eye(3), T_cam_world=np.eye(4))
        views.append(View(name=str(k), camera=camera, image=image, landmarks={"68": np.zeros((68, 3))}))
    return Capture(root=root, subject="s", expression="e", views=tuple(views))


def test_the_capture_hash_depends_on_content_and_not_on_location(tmp_path):
    a, b = a_capture(tmp_path / "a"), a_capture(tmp_path / "b")
    assert hash_capture(a) == hash_capture(b)
    os.utime(b.views[0].image, (0, 0))
    assert hash_capture(a) == hash_capture(b)
    first, second = a.views
    other_camera = replace(first, camera=replace(first.camera, T_cam_world=np.diag([1.0, 1, 1, 1]) * 1.0001))
    marked = replace(first, landmarks={"68": np.ones((68, 3))})
    unmarked = replace(first, landmarks={})
    for changed in (other_camera, marked, unmarked):
        assert hash_capture(replace(a, views=(changed, second))) != hash_capture(a)
    assert hash_capture(replace(a, views=(first,))) != hash_capture(a)
    assert hash_capture(replace(a, scan=first.image)) != hash_capture(a)
    b.views[0].image.write_bytes(b"other")
    assert hash_capture(a) != hash_capture(b)


def test_hash_file_is_sha256(tmp_path):
    (tmp_path / "f").write_bytes(b"abc")
    assert hash_file(tmp_path / "f") == "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad"
