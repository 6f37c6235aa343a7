"""The ledger says where normals come from that no file holds, and of how many pixels."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from registration.capture import native
from registration.capture.scan import Scan
from registration.doctor.ledger import Channel, Ledger
from registration.doctor.validation import validate_capture
from tests.registration.capture import small


def checked(root: Path, scan: Scan, drop: tuple[str, ...] = ("normals",), **settings) -> tuple[Channel | None, Ledger]:
    """The ledger of the small capture with another scan, and its row of the scan's normals."""
    capture = native.read_capture(small.make(root, drop=drop))
    assert capture.scan is not None
    write_scan(capture.scan, scan)
    ledger = validate_capture(capture, **settings)
    return next((row for row in ledger.channels if row.name == "scan normals"), None), ledger


def write_scan(path: Path, scan: Scan) -> None:
    lines = ["ply", "format ascii 1.0", f"element vertex {len(scan.vertices)}"]
    lines += [f"property double {axis}" for axis in "xyz"]
    lines += [f"element face {len(scan.triangles)}", "property list uchar int vertex_indices", "end_header"]
    lines += [" ".join(map(str, vertex)) for vertex in scan.vertices.tolist()]
    lines += [" ".join(map(str, (3, *corners))) for corners in scan.triangles.tolist()]
    path.write_text("\n".join(lines) + "\n", encoding="ascii")


def test_views_without_normal_maps_get_the_scan_s(tmp_path: Path) -> None:
    row, ledger = checked(tmp_path / "capture", small.ball())
    assert row is not None and row.matched == 5 and row.unit == "sampled pixels"
    assert row.counted + sum(row.losses.values()) == row.total
    assert 0.8 < row.counted / row.total < 0.99  # all but grazing ones
    assert row.losses["at an edge or grazing"] > 0 and row.losses["no surface"] < 0.02 * row.total
    assert not [line for line in ledger.warnings if "normals" in line]


def test_views_with_normal_maps_do_not(tmp_path: Path) -> None:
    assert checked(tmp_path / "capture", small.ball(), drop=())[0] is None


def test_nor_does_anything_if_the_scan_is_only_measured(tmp_path: Path) -> None:
    assert checked(tmp_path / "capture", small.ball(), use_scan=False)[0] is None


def test_a_hole_costs_its_pixels(tmp_path: Path) -> None:
    ball = small.ball()
    whole = checked(tmp_path / "whole", ball)[0]
    kept = ball.vertices[ball.triangles].mean(1)[:, 1] < 0.02
    row = checked(tmp_path / "capture", replace(ball, triangles=ball.triangles[kept]))[0]
    assert row is not None and whole is not None and row.counted < 0.8 * whole.counted


def test_a_cloud_gives_none_and_says_so(tmp_path: Path) -> None:
    cloud = replace(small.ball(), triangles=np.zeros((0, 3), np.int64))
    row, ledger = checked(tmp_path / "capture", cloud)
    assert row is None
    assert [line for line in ledger.warnings if "5 of 5 views have no normals" in line and "point cloud" in line]


def test_a_scrap_of_a_scan_is_a_warning(tmp_path: Path) -> None:
    ball = small.ball()
    kept = np.linalg.norm(ball.vertices[ball.triangles].mean(1) - [0, 0, 0.09], axis=1) < 0.04
    row, ledger = checked(tmp_path / "capture", replace(ball, triangles=ball.triangles[kept]))
    assert row is not None and row.counted < 0.2 * row.total
    assert [line for line in ledger.warnings if "normals stand in for normal maps on" in line]
