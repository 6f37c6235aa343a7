"""Heads found in scans, whatever their unit and axes, and what is no head refused."""

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from registration.capture.native import read_capture
from registration.capture.scan import read_scan, read_scan_file
from registration.capture.triangulation import triangulate
from registration.errors import InputError
from registration.inputs import read_schemes
from registration.model import gnm_npz
from registration.model.gnm_npz import GNMData
from registration.scan_capture.hygiene import RawScan, clean
from registration.scan_capture.make import ScanSource, make_capture
from registration.scan_capture.placement import Search
from registration.storage.mesh import write_ply
from tests.conftest import SHARED, needs_shared

pytestmark = [needs_shared, pytest.mark.slow]
MODEL = SHARED / "data" / "gnm" / "gnm_head_reconstructed.npz"
CAPTURE = SHARED / "data" / "captures" / "ict_dev" / "neutral"
TURN = Rotation.from_euler("xyz", (80, 20, -100), degrees=True).as_matrix()


@cache
def model() -> GNMData:
    return gnm_npz.read(MODEL)


@cache
def scan() -> RawScan:
    return clean(read_scan_file(CAPTURE / "scan.ply"), CAPTURE)[0]


def search(spoilt: RawScan) -> Search:
    return Search(spoilt, model(), "scan.ply")


def test_a_face_is_found_in_millimetres_turned_and_inside_out() -> None:
    plain = search(scan()).without_landmarks(None)
    assert plain.unit == "m" and not plain.inside_out and plain.inliers > 0.85
    assert np.degrees(Rotation.from_matrix(plain.placement.rotation).magnitude()) < 10
    spoilt = replace(scan(), vertices=1e3 * scan().vertices @ TURN.T + [100, -3000, 50]).turned_over()
    found = search(spoilt).without_landmarks(None)
    assert found.unit == "mm" and found.inside_out
    turned = TURN.T @ found.placement.rotation
    assert np.degrees(Rotation.from_matrix(turned @ plain.placement.rotation.T).magnitude()) < 3
    back = (found.placement.shift - 1e-3 * np.array([100, -3000, 50])) @ TURN
    assert np.linalg.norm(back - plain.placement.shift) < 0.01


def test_the_face_alone_is_enough() -> None:
    centre = scan().vertices[scan().triangles].mean(1)
    face = scan().with_faces((centre[:, 2] > 0.04) & (np.abs(centre[:, 0]) < 0.08) & (centre[:, 1] > -0.11))
    found = search(face).without_landmarks(None)
    assert np.degrees(Rotation.from_matrix(found.placement.rotation).magnitude()) < 12


def test_two_heads_and_no_head_are_refused() -> None:
    one, count = scan(), len(scan().vertices)
    both = replace(
        one,
        vertices=np.concatenate([one.vertices, one.vertices + [0.4, 0, 0]]),
        triangles=np.concatenate([one.triangles, one.triangles + count]),
    )
    with pytest.raises(InputError, match="two heads"):
        search(both).without_landmarks("m")
    ball = trimesh.creation.icosphere(subdivisions=5, radius=0.1)
    sphere = RawScan(
        vertices=np.array(ball.vertices),
        triangles=np.array(ball.faces),
        colours=None,
        corner_uvs=None,
        face_textures=None,
        textures=(),
    )
    with pytest.raises(InputError, match="No face"):
        search(sphere).without_landmarks("m")
    with pytest.raises(InputError, match="no head's size"):
        search(replace(one, vertices=1e7 * one.vertices)).without_landmarks(None)


def test_a_scan_in_pieces_that_do_not_fit_is_refused() -> None:
    one = scan()
    rng = np.random.default_rng(0)
    cell = np.floor(one.vertices[one.triangles].mean(1) / 0.02).astype(int)
    _, piece = np.unique(cell, axis=0, return_inverse=True)
    shift = rng.normal(0, 0.03, (piece.max() + 1, 3))
    corners = one.vertices[one.triangles] + shift[piece.ravel()][:, None]
    apart = replace(one, vertices=corners.reshape(-1, 3), triangles=np.arange(3 * len(corners)).reshape(-1, 3))
    with pytest.raises(InputError, match="No face"):
        search(apart).without_landmarks("m")


def test_landmarks_place_the_head_and_wrong_ones_are_refused() -> None:
    points, schemes = triangulate(read_capture(CAPTURE), "68")[0], read_schemes(MODEL, model(), {})
    scheme = schemes["68"]
    few = points.copy()
    few[np.arange(68) % 4 > 0] = np.nan
    found = search(scan().scaled(100)).from_landmarks(100 * few, scheme, model(), None)
    assert found.unit == "cm" and found.inliers > 0.9 and "17 landmarks" in found.figures["placed_by"]
    cases = {
        "mirrored": (points * [-1, 1, 1], replace(scan(), vertices=scan().vertices * [-1, 1, 1]).turned_over(), None),
        "do not lie on the scan": (points + [0, 0.1, 0], scan(), None),
        "no head's size": (points, scan(), "mm"),
        "Too few": (np.where(np.arange(68)[:, None] < 5, points, np.nan), scan(), None),
    }
    for words, (picked, spoilt, unit) in cases.items():
        with pytest.raises(InputError, match=words):
            search(spoilt).from_landmarks(picked, scheme, model(), unit)


def test_a_capture_is_made_used_again_and_replaced(tmp_path: Path) -> None:
    schemes = read_schemes(MODEL, model(), {})
    points = triangulate(read_capture(CAPTURE), "68")[0]
    np.savez(tmp_path / "points.npz", points=1e3 * points)
    source = read_scan(CAPTURE / "scan.ply")
    write_ply(tmp_path / "scan.ply", 1e3 * source.vertices, source.triangles)
    given = ScanSource(file=tmp_path / "scan.ply", landmarks=tmp_path / "points.npz")
    made = make_capture(given, tmp_path / "capture", model(), schemes)
    capture = read_capture(made.root)
    assert not capture.photographs and capture.head is None and len(capture.views) > 12
    assert made.figures["unit"] == "mm" and made.figures["counted_area"] > 0.5
    np.testing.assert_allclose(triangulate(capture, "68")[0], points, atol=1e-5)
    np.testing.assert_allclose(read_scan(made.root / "scan.ply").vertices, source.vertices, atol=1e-6)
    before = (made.root / "capture.toml").stat().st_mtime_ns
    again = make_capture(given, tmp_path / "capture", model(), schemes)
    assert again.notes == made.notes and (made.root / "capture.toml").stat().st_mtime_ns == before
    other = make_capture(replace(given, landmarks=None), tmp_path / "capture", model(), schemes)
    replaced = read_capture(other.root)
    assert replaced.head is not None and not replaced.views[0].landmarks
    (tmp_path / "mine").mkdir()
    with pytest.raises(InputError, match="exists already"):
        make_capture(given, tmp_path / "mine", model(), schemes)
