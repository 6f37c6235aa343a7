"""Alembic (Ogawa): a head or a sequence of heads as one polygon mesh of constant topology, by the package alembic3d."""

from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from registration.export.head_mesh import HeadMesh, unit_normals

MODULE = "alembic3d"  # the package has the same name


def write_abc(mesh: HeadMesh, file: Path, texture: str | None) -> None:
    """Write a head: metres, +Y up, quads, uvs and normals, one face set per part. The texture is only beside it.

    Alembic's faces run clockwise when seen from outside, so corners are written in reverse.

    Args:
        mesh: the head; its frames become samples, one per frame from time 0.
        file: the archive.
        texture: not named in the file: Alembic has no materials that programs share.
    """
    import imath
    from alembic3d import Abc, AbcCoreAbstract, AbcGeom

    topology = mesh.topology
    archive = Abc.OArchive(str(file))
    timing = archive.addTimeSampling(AbcCoreAbstract.TimeSampling(1 / mesh.frames_per_second, 0.0))
    transform = AbcGeom.OXform(archive.getTop(), "head")
    schema = AbcGeom.OPolyMesh(transform, "mesh", timing).getSchema()
    uvs, index = np.unique(topology.face_uvs.reshape(-1, 2), axis=0, return_inverse=True)
    corners = topology.faces[:, ::-1].reshape(-1)
    uv_index = index.reshape(topology.faces.shape)[:, ::-1].reshape(-1)
    counts = np.full(len(topology.faces), topology.faces.shape[1])
    scopes = AbcGeom.GeometryScope
    unsigned = imath.UnsignedIntArray(_filled(imath.DoubleArray, uv_index))  # NumPy cannot write into it
    uv_sample = AbcGeom.OV2fGeomParamSample(_filled(imath.V2fArray, uvs), unsigned, scopes.kFacevaryingScope)
    # Each row is written before the next is computed: a sequence may be long.
    for number, vertices in enumerate(mesh.vertices[None] if mesh.frames is None else mesh.frames):
        normals = AbcGeom.ON3fGeomParamSample(
            _filled(imath.V3fArray, unit_normals(vertices, topology.triangles)), scopes.kVertexScope
        )
        points = _filled(imath.V3fArray, vertices)
        if number == 0:
            indices, sizes = _filled(imath.IntArray, corners), _filled(imath.IntArray, counts)
            schema.set(AbcGeom.OPolyMeshSchemaSample(points, indices, sizes, uv_sample, normals))
            for material, name in enumerate(topology.materials):
                members = _filled(imath.IntArray, np.flatnonzero(topology.face_material == material))
                schema.createFaceSet(name).getSchema().set(AbcGeom.OFaceSetSchemaSample(members))
        else:
            sample = AbcGeom.OPolyMeshSchemaSample()
            sample.setPositions(points)
            sample.setNormals(normals)
            schema.set(sample)


def _filled(kind: Any, rows: Float[np.ndarray, "N ..."] | np.ndarray) -> Any:
    """An array of imath with these values."""
    array = kind(len(rows))
    np.asarray(array)[:] = rows
    return array
