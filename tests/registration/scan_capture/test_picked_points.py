"""Landmark files of scans, as menpo, MeshLab and people write them."""

import json
from pathlib import Path

import numpy as np
import pytest

from registration.errors import InputError
from registration.scan_capture.picked_points import read_picked_points

POINTS = np.random.default_rng(0).normal(size=(68, 3)).round(6)
LENGTHS = {"68": 68, "few": 4}


def partial_points() -> np.ndarray:
    points = POINTS.copy()
    points[[0, 7]] = np.nan
    return points


def write(folder: Path, kind: str) -> Path:
    points = partial_points()
    rows = [None if np.isnan(p).any() else p.tolist() for p in points]
    nulls = [[None, None, None] if row is None else row for row in rows]
    file = folder / f"points{kind}"
    if kind == ".npz":
        np.savez(file, points=points)
    elif kind == ".txt":
        file.write_text("# x y z\n" + "\n".join("{}, {}, {}".format(*p) for p in points))
    elif kind == ".json":
        file.write_text(json.dumps({"68": rows}))
    elif kind == ".v2.ljson":
        file.write_text(json.dumps({"version": 2, "labels": [], "landmarks": {"points": nulls, "connectivity": []}}))
    elif kind == ".v3.ljson":
        group = {"labels": [], "landmarks": {"points": nulls}}
        file.write_text(json.dumps({"version": 3, "groups": {"LJSON": group}}))
    elif kind == ".v1.ljson":
        members = [{"point": row} for row in nulls]
        halves = [{"label": "a", "landmarks": members[:20]}, {"label": "b", "landmarks": members[20:]}]
        file.write_text(json.dumps({"version": 1, "groups": halves}))
    else:
        lines = [
            f'<point x="{p[0]}" y="{p[1]}" z="{p[2]}" active="1" name="{k}"/>'
            for k, p in reversed(list(enumerate(points)))
            if np.isfinite(p).all()
        ]
        file.write_text(
            "<!DOCTYPE PickedPoints>\n<PickedPoints>\n<DocumentData/>" + "\n".join(lines) + "</PickedPoints>"
        )
    return file


@pytest.mark.parametrize("kind", [".npz", ".txt", ".json", ".v1.ljson", ".v2.ljson", ".v3.ljson", ".pp"])
def test_all_formats_give_the_same_points(tmp_path: Path, kind: str) -> None:
    found = read_picked_points(write(tmp_path, kind), None, LENGTHS)
    assert found.scheme == "68"
    np.testing.assert_allclose(found.points, partial_points(), atol=1e-12)


def test_a_stated_scheme_and_meshlab_points_with_names_and_inactive_ones(tmp_path: Path) -> None:
    file = tmp_path / "a.pp"
    file.write_text(
        '<PickedPoints><point x="1" y="2" z="3" name="nose"/><point x="0" y="0" z="0" name="ear" active="0"/>'
        '<point x="1" y="1" z="1" name="lip"/><point x="2" y="2" z="2" name="chin"/></PickedPoints>'
    )
    found = read_picked_points(file, "few", LENGTHS)
    assert found.scheme == "few" and found.points[0].tolist() == [1, 2, 3] and np.isnan(found.points[1]).all()


@pytest.mark.parametrize(
    ("name", "content", "got"),
    [
        ("a.txt", "1 2 3\n4 5\n", "2 in line 2"),
        ("a.txt", "1 2 x\n", "'1 2 x' in line 1"),
        ("a.txt", "1 2 3\n", "1 points"),
        ("a.json", "[1, 2", "no JSON"),
        ("a.json", '{"other": []}', "neither"),
        ("a.json", "3", "int"),
        ("a.ljson", '{"version": 3, "groups": {"a": {"landmarks": {"points": [[1, 2]]}}}}', "(1, 2)"),
        ("a.pp", '<!DOCTYPE a [<!ENTITY b "c">]><PickedPoints/>', "entity"),
        ("a.pp", "<PickedPoints>", "no element found"),
        ("a.pp", '<PickedPoints><point x="1" y="2"/></PickedPoints>', "x"),
        ("a.csv", "1,2,3", "a.csv"),
    ],
)
def test_what_cannot_be_used_is_refused(tmp_path: Path, name: str, content: str, got: str) -> None:
    (tmp_path / name).write_text(content)
    with pytest.raises(InputError) as error:
        read_picked_points(tmp_path / name, None, LENGTHS)
    assert got in error.value.got


def test_a_point_with_one_missing_coordinate_is_refused(tmp_path: Path) -> None:
    points = POINTS.copy()
    points[3, 1] = np.nan
    np.savez(tmp_path / "a.npz", points=points)
    with pytest.raises(InputError, match="cannot be read") as error:
        read_picked_points(tmp_path / "a.npz", None, LENGTHS)
    assert error.value.got == "row 3"
