"""`gnmreg model map` on a model and a mesh file."""

import numpy as np
import pytest

from registration.errors import InputError
from registration.model.landmarks import write_scheme
from registration.progress import NullProgress
from registration.storage.mesh import write_ply
from registration.topology_map import file, landmarked
from registration.topology_map.make import map_topologies
from tests.conftest import FIXTURES
from tests.registration.topology_map.small_map import QUICK, pair
from workflows.cli.__main__ import main
from workflows.steps import topology_map
from workflows.steps.topology_map import lines, make_topology_map

MODEL = FIXTURES / "tiny_gnm.npz"


@pytest.fixture(autouse=True)
def quick(monkeypatch):
    monkeypatch.setattr(
        topology_map, "map_topologies", lambda a, b, progress=None: map_topologies(a, b, QUICK, progress)
    )


@pytest.fixture
def mesh(tmp_path):
    """The small model with other triangles, as a PLY file with its landmarks beside it."""
    target = pair().target
    write_ply(tmp_path / "head.ply", target.vertices, target.triangles)
    write_scheme(target.schemes["68"], tmp_path / "head.ply")
    return tmp_path / "head.ply"


def test_a_mesh_file_is_mapped(mesh, tmp_path):
    mapped = make_topology_map(MODEL, mesh, tmp_path / "map.npz", None, NullProgress())
    read = file.read(tmp_path / "map.npz")
    assert mapped.accepted and read.accepted and not (tmp_path / "map.png").exists()
    read.check(landmarked.read(MODEL).triangles, landmarked.read(mesh).triangles, "map.npz")
    assert "accepted" in lines(read) and len(lines(read)) == 5


def test_a_refused_map_is_written_with_its_picture(mesh, tmp_path, capsys, monkeypatch):
    from dataclasses import replace

    strict = replace(QUICK, mean_mm=0.0)
    monkeypatch.setattr(
        topology_map, "map_topologies", lambda a, b, progress=None: map_topologies(a, b, strict, progress)
    )
    assert main(["model", "map", str(MODEL), str(mesh), "--out", str(tmp_path / "map.npz")]) == 1
    assert file.read(tmp_path / "map.npz").reasons[0].startswith("the bent vertices are")
    assert (tmp_path / "map.png").is_file()
    assert "refused" in capsys.readouterr().out


def test_bad_input_is_refused_before_anything_is_written(mesh, tmp_path):
    (tmp_path / "broken.ply").write_bytes(b"ply\nnothing")
    write_ply(tmp_path / "nan.ply", np.full((3, 3), np.nan), np.array([[0, 1, 2]]))
    (tmp_path / "elsewhere").mkdir()
    write_ply(tmp_path / "elsewhere" / "bare.ply", pair().target.vertices, pair().target.triangles)
    for target, message in (
        ("missing.ply", "mesh cannot be read"),
        ("broken.ply", "mesh cannot be read"),
        ("nan.ply", "cannot be read|landmark"),
        ("elsewhere/bare.ply", "too few landmarks"),
    ):
        with pytest.raises(InputError, match=message):
            make_topology_map(MODEL, tmp_path / target, tmp_path / "map.npz", None, NullProgress())
    assert not (tmp_path / "map.npz").exists()
