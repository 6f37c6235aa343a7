"""Alembic archives, read back by the library."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from registration.export.head_mesh import unit_normals
from registration.export.registrations import head_of_registration
from registration.export.write import write
from tests.registration.export.heads import DATA, a_registration

pytest.importorskip("alembic3d", reason="alembic3d is not installed")

HEAD = head_of_registration(a_registration(), DATA, name="anna")


@pytest.mark.parametrize("count", [None, 3])
def test_the_archive_holds_every_frame(count: int | None, tmp_path: Path) -> None:
    from alembic3d import Abc, AbcGeom

    motion = DATA.expression_basis[3].astype(np.float32)
    frames = None if count is None else np.stack([HEAD.vertices.astype(np.float32) + k * motion for k in range(count)])
    [file, *beside] = write(replace(HEAD, frames=frames, frames_per_second=25), tmp_path / "head.abc")
    assert [path.name for path in beside] == ["head.png"]
    archive = Abc.IArchive(str(file))
    schema = AbcGeom.IPolyMesh(archive.getTop().children[0], "mesh").getSchema()
    assert schema.getNumSamples() == (count or 1)
    for number, frame in enumerate(HEAD.vertices[None] if frames is None else frames):
        sample = schema.getValue(Abc.ISampleSelector(number / 25))
        np.testing.assert_array_equal(np.asarray(sample.getPositions()), frame.astype(np.float32))
        corners = np.asarray(sample.getFaceIndices()).reshape(-1, 4)
        np.testing.assert_array_equal(corners[:, ::-1], DATA.quads)  # clockwise, as Alembic has them
        assert set(np.asarray(sample.getFaceCounts())) == {4}
        normals = schema.getNormalsParam().getExpandedValue(Abc.ISampleSelector(number / 25)).getVals()
        np.testing.assert_allclose(np.asarray(normals), unit_normals(frame, HEAD.topology.triangles), atol=1e-6)
    uvs = schema.getUVsParam()
    assert uvs.getScope() == AbcGeom.GeometryScope.kFacevaryingScope
    values = uvs.getIndexedValue()
    flat = np.asarray(values.getVals())[np.asarray(values.getIndices())].reshape(-1, 4, 2)
    np.testing.assert_array_equal(flat[:, ::-1], HEAD.topology.face_uvs)
    names = schema.getFaceSetNames()
    assert sorted(names[k] for k in range(len(names))) == ["eyes", "skin", "teeth", "tongue"]
    for number, name in enumerate(HEAD.topology.materials):
        members = np.asarray(schema.getFaceSet(name).getSchema().getValue().getFaces())
        np.testing.assert_array_equal(members, np.flatnonzero(HEAD.topology.face_material == number))
