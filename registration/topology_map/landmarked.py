"""A mesh with landmarks, as the two sides of a map between topologies are; of a head model, or of a mesh file."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Int

from registration.errors import InputError
from registration.geometry.nonrigid_icp import normals
from registration.geometry.rasterizer import RayCaster
from registration.geometry.topology import connected_parts
from registration.model import gnm_npz, regions
from registration.model.gnm_npz import GNMData
from registration.model.landmarks import LandmarkScheme, schemes_beside, shipped_schemes
from registration.storage.mesh_files import SUFFIXES, read_mesh
from registration.storage.reading import open_file

# A vertex that faces another surface within it is inside a mouth, nostril, lid or ear.
_CAVITY_M = 0.012  # of models: vertex groups tell most of it
_UNGROUPED_CAVITY_M = 0.020  # of meshes without groups: as deep as nostrils
_SKIN = "skin"


@dataclass(frozen=True, kw_only=True, eq=False)
class LandmarkedMesh:
    """A head's surface with landmarks. Metres, except the target of a map, which may have any unit and frame."""

    name: str  # for people
    vertices: Float[np.ndarray, "V 3"]
    triangles: Int[np.ndarray, "F 3"]
    schemes: Mapping[str, LandmarkScheme]
    members: Bool[np.ndarray, "V"]  # the outer surface that a map is made on
    whole: Bool[np.ndarray, "V"]  # that with ears and rims, which find the place of the head
    parts: Mapping[str, Bool[np.ndarray, "V"]] = field(default_factory=dict)  # components of the mesh; `skin` is one

    @property
    def skin(self) -> Bool[np.ndarray, "V"]:
        """The part that is bent: the component with the face."""
        return self.parts[_SKIN]


def of_model(data: GNMData, schemes: Mapping[str, LandmarkScheme], name: str) -> LandmarkedMesh:
    """Return a head model's template with all landmarks that are known of its topology.

    Args:
        data: the model.
        schemes: those beside its file; they replace the package's of the same name.
        name: for people.

    Raises:
        InputError: a vertex group is missing.
    """
    vertices = data.template_vertex_positions.astype(np.float64)
    triangles = data.triangles.astype(np.int64)
    labels = regions.components(data)
    parts = {name: labels == number for number, name in enumerate(data.mesh_component_names.tolist())}
    return LandmarkedMesh(
        name=name,
        vertices=vertices,
        triangles=triangles,
        schemes={**shipped_schemes(data), **schemes},
        members=regions.outer_surface(data) & ~_cavities(vertices, triangles, _CAVITY_M),
        whole=regions.exterior(data),
        parts=parts,
    )


def of_mesh(
    vertices: Float[np.ndarray, "V 3"],
    triangles: Int[np.ndarray, "F 3"],
    schemes: Mapping[str, LandmarkScheme],
    name: str,
    unit_m: float = 1.0,
) -> LandmarkedMesh:
    """Return a mesh without vertex groups: what of it is mapped, the other side's groups decide.

    Args:
        vertices: in any unit and frame.
        triangles: the largest of the connected parts is the skin.
        schemes: landmarks.
        name: for people.
        unit_m: metres of the vertices' unit, roughly.
    """
    triangles = triangles.astype(np.int64)
    labels = connected_parts(triangles)
    cavities = _cavities(unit_m * vertices, triangles, _UNGROUPED_CAVITY_M)
    skin = np.zeros(len(vertices), bool)
    skin[triangles[labels == np.bincount(labels).argmax()]] = True
    return LandmarkedMesh(
        name=name,
        vertices=vertices.astype(np.float64),
        triangles=triangles,
        schemes=dict(schemes),
        members=skin & ~cavities,
        whole=skin,
        parts={_SKIN: skin},
    )


def read(path: Path) -> LandmarkedMesh:
    """Read a head model (NPZ), or a mesh (OBJ, PLY, GLB; metres), with the landmark schemes beside it.

    Raises:
        InputError: the file cannot be read, or the mesh has vertices that are not finite or no triangles.
    """
    path = Path(path)
    if path.suffix.lower() not in SUFFIXES:
        data = gnm_npz.read(path)
        return of_model(data, schemes_beside(path, data.template_vertex_positions), path.name)
    refuse = partial(InputError.unreadable, "mesh", where=path, fix="give a head model or an undamaged mesh file")
    with open_file(path, refuse):
        pass
    try:
        mesh = read_mesh(path)
    except (ValueError, OSError) as error:
        raise refuse(expected="an undamaged mesh file", got=error) from None
    if not np.isfinite(mesh.vertices).all() or not len(mesh.triangles):
        raise refuse(expected="triangles of finite vertices", got=f"{len(mesh.triangles)} triangles, or NaN")
    return of_mesh(mesh.vertices, mesh.triangles, schemes_beside(path, mesh.vertices), path.name)


def _cavities(
    vertices: Float[np.ndarray, "V 3"], triangles: Int[np.ndarray, "F 3"], depth_m: float
) -> Bool[np.ndarray, "V"]:
    """Vertices that face another surface nearby: inside mouth, nostrils, lids and ears, and lips that touch."""
    outwards = normals(vertices.astype(np.float64), triangles)
    return RayCaster(vertices, triangles).blocked(vertices, outwards, 2e-4, depth_m)
