"""The mesh that all export formats write, and how the model's quads and materials get on it."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Float, Int, UInt8

from registration.errors import InputError
from registration.geometry.topology import vertex_normals
from registration.model import regions
from registration.model.atlas import texture_atlas
from registration.model.gnm_npz import GNMData, topology_hash


@dataclass(frozen=True, kw_only=True, eq=False)
class Topology:
    """Connectivity, uvs and materials of a head. F triangles, Q faces of S corners: the model's quads (S = 4)."""

    vertex_count: int
    triangles: Int[np.ndarray, "F 3"]
    triangle_uvs: Float[np.ndarray, "F 3 2"]  # v = 0 at the bottom of the texture
    faces: Int[np.ndarray, "Q S"]
    face_uvs: Float[np.ndarray, "Q S 2"]  # the same map
    materials: tuple[str, ...]  # skin, eyes, teeth, tongue
    triangle_material: Int[np.ndarray, "F"]  # index into `materials`
    face_material: Int[np.ndarray, "Q"]

    @classmethod
    def from_model(cls, data: GNMData, uvs: Float[np.ndarray, "F 3 2"] | None = None) -> "Topology":
        """Return the topology of a model.

        Args:
            data: the model.
            uvs: of the triangles' corners; None: those of its texture atlas.

        Raises:
            InputError: a vertex is in no component, or the quads are not the triangles' surface.
        """
        uvs = texture_atlas(data) if uvs is None else uvs
        names, of_vertex = regions.materials(data)
        quads = data.quads.astype(np.int64)
        corners = _quad_corners(quads, data.triangles.astype(np.int64))
        return cls(
            vertex_count=len(data.template_vertex_positions),
            triangles=data.triangles.astype(np.int64),
            triangle_uvs=uvs,
            faces=quads,
            face_uvs=uvs.reshape(-1, 2)[corners],
            materials=names,
            triangle_material=of_vertex[data.triangles[:, 0]],
            face_material=of_vertex[quads[:, 0]],
        )

    def check(self, triangles: Int[np.ndarray, "F 3"], where: object) -> None:
        """Refuse a mesh of another topology. Raises InputError."""
        if topology_hash(triangles) != topology_hash(self.triangles):
            raise InputError(
                "A registration has another topology than the model",
                where=where,
                expected=f"the model's {len(self.triangles)} triangles",
                got=f"{len(triangles)} triangles, or another order",
                fix="give the model that it was registered with, with --model",
            )


@dataclass(frozen=True, kw_only=True, eq=False)
class HeadMesh:
    """A head to export: metres, vertices in the model's order. T frames of a sequence."""

    name: str
    vertices: Float[np.ndarray, "V 3"]
    topology: Topology
    texture: UInt8[np.ndarray, "R R 3"] | None = None  # sRGB, row 0 at v = 1
    unseen: UInt8[np.ndarray, "R R"] | None = None  # 255 where no camera saw the texel and it was filled
    shapes: Mapping[str, Float[np.ndarray, "V 3"]] = field(default_factory=dict)  # name -> displacement at weight 1
    shape_figures: Mapping[str, Mapping[str, float]] = field(default_factory=dict)  # name -> how well it was solved
    frames: Float[np.ndarray, "T V 3"] | None = None  # vertices of each frame
    frames_per_second: float = 24.0
    origin: Mapping[str, object] = field(default_factory=dict)  # JSON values: what it is and where it comes from

    @cached_property
    def normals(self) -> Float[np.ndarray, "V 3"]:
        """Unit normals of `vertices`."""
        return unit_normals(self.vertices, self.topology.triangles)


def unit_normals(vertices: Float[np.ndarray, "V 3"], triangles: Int[np.ndarray, "F 3"]) -> Float[np.ndarray, "V 3"]:
    """Return vertex normals, all of unit length as formats demand: +Y where there is no area around a vertex."""
    points, faces = torch.from_numpy(vertices.astype(np.float64)), torch.from_numpy(triangles.astype(np.int64))
    normals = vertex_normals(points, faces).numpy()
    normals[np.linalg.norm(normals, axis=1) < 0.5] = (0, 1, 0)
    return np.asarray(normals)


def _quad_corners(quads: Int[np.ndarray, "Q 4"], triangles: Int[np.ndarray, "F 3"]) -> Int[np.ndarray, "Q 4"]:
    """The corner (3 * triangle + k) at each corner of the quads. Raises InputError if the surfaces differ."""
    size = int(max(quads.max(initial=0), triangles.max(initial=0))) + 1
    if size**3 >= 2**63:
        raise ValueError(f"{size} vertices")

    def key(rows: Int[np.ndarray, "... 3"]) -> Int[np.ndarray, "..."]:
        low, middle, high = np.moveaxis(np.sort(rows, -1), -1, 0)
        return (low * size + middle) * size + high

    halves = quads[:, [[0, 1, 2], [2, 3, 0], [1, 2, 3], [3, 0, 1]]]  # by either diagonal
    order = np.argsort(key(triangles))
    sorted_keys, wanted = key(triangles)[order], key(halves)
    place = np.minimum(np.searchsorted(sorted_keys, wanted), len(triangles) - 1)
    found = sorted_keys[place] == wanted
    pair = np.where(found[:, :2].all(1), 0, 2)
    rows = np.arange(len(quads))
    both = found[rows, pair] & found[rows, pair + 1]
    if not both.all() or 2 * len(quads) != len(triangles):
        raise InputError(
            "The model's quads are another surface than its triangles",
            where="quads, triangles",
            expected="two triangles for every quad",
            got=f"{len(quads)} quads, {np.count_nonzero(both)} of which are two of the {len(triangles)} triangles",
            fix="use a model file whose quads and triangles belong together",
        )
    first, second = (order[place[rows, pair + k]] for k in (0, 1))
    corners = np.empty(quads.shape, np.int64)
    for triangle in (first, second):
        match = quads[:, :, None] == triangles[triangle][:, None, :]
        quad, corner, k = np.nonzero(match)
        corners[quad, corner] = 3 * triangle[quad] + k
    return corners
