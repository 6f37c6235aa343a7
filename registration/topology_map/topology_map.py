"""A map between two topologies: for every vertex of the target its point on the source's surface, and back."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float, Int, Shaped

from registration.errors import InputError
from registration.geometry.closest_point import closest_points
from registration.model.gnm_npz import topology_hash
from registration.model.landmarks import LandmarkScheme

Status = Literal["accepted", "refused"]
_DIGITS = 16  # of a hash in messages


@dataclass(frozen=True, kw_only=True, eq=False)
class SurfacePoints:
    """Where each of V vertices lies on another mesh's surface."""

    triangle: Int[np.ndarray, "V"]
    barycentric: Float[np.ndarray, "V 3"]  # rows sum to 1
    distance_m: Float[np.ndarray, "V"]  # of the bent vertex from its point
    mask: Bool[np.ndarray, "V"]  # the correspondence was found; elsewhere it is an extrapolation
    offset: Float[np.ndarray, "V 3"]  # from the point to the bent vertex, in the other mesh's frame and unit


@dataclass(frozen=True, kw_only=True, eq=False)
class TopologyMap:
    """Carries values from the vertices of a source (A) to those of a target (B).

    The target was bent onto the source's template; distances are metres of the source.
    """

    source_triangles: Int[np.ndarray, "F 3"]
    target_triangles: Int[np.ndarray, "G 3"]
    points: SurfacePoints  # of the target's vertices, on the source
    back: SurfacePoints  # of the source's vertices, on the target
    scale: float  # of the similarity from the target's frame to the source's: a = scale R b + t
    rotation: Float[np.ndarray, "3 3"]
    translation: Float[np.ndarray, "3"]
    status: Status = "accepted"
    reasons: tuple[str, ...] = ()  # why it was refused
    figures: Mapping[str, float]  # what was measured; names with units

    @property
    def accepted(self) -> bool:
        """Whether the map passed its checks."""
        return self.status == "accepted"

    @property
    def mask(self) -> Bool[np.ndarray, "V"]:
        """The target's vertices whose correspondence was found."""
        return self.points.mask

    @cached_property
    def source_topology(self) -> str:
        """The hash of the source's triangles (`gnm_npz.topology_hash`)."""
        return topology_hash(self.source_triangles)

    @cached_property
    def target_topology(self) -> str:
        """The hash of the target's triangles."""
        return topology_hash(self.target_triangles)

    @cached_property
    def _corners(self) -> Int[np.ndarray, "V 3"]:
        return self.source_triangles[self.points.triangle]

    def carry(self, values: Shaped[np.ndarray, "..."], axis: int | None = None) -> Shaped[np.ndarray, "..."]:
        """Interpolate values of the source's vertices at the target's: bases, groups, masks, points of the surface.

        Displacements stay in the source's frame and unit.

        Args:
            values: with an axis of the source's vertices.
            axis: that axis; None: the only one of that length.

        Returns:
            The same with the target's vertices on that axis. Booleans are true where more than half of the weight is.

        Raises:
            ValueError: no axis has the source's number of vertices, or several have.
        """
        count = len(self.back.triangle)
        found = [k for k, length in enumerate(values.shape) if length == count] if axis is None else [axis]
        if len(found) != 1 or values.shape[found[0]] != count:
            raise ValueError(f"values of shape {values.shape} do not have one axis of {count} vertices")
        if values.dtype == bool:
            return np.asarray(self.carry(values.astype(np.float32), found[0]) > 0.5)
        kind = values.dtype if values.dtype.kind == "f" else np.dtype(np.float64)
        rows = np.moveaxis(values, found[0], 0)
        weights = self.points.barycentric.reshape(*self.points.barycentric.shape, *[1] * (rows.ndim - 1))
        carried = sum(weights[:, k].astype(kind) * rows[self._corners[:, k]] for k in range(3))
        return np.moveaxis(np.asarray(carried, kind), 0, found[0])

    def place(self, vertices: Float[np.ndarray, "*B A 3"]) -> Float[np.ndarray, "*B V 3"]:
        """Return the target's mesh on heads of the source's topology, in their frame.

        Off the mask the vertices keep their offsets from the surface.

        Args:
            vertices: of the source's topology, metres, turned as its template.
        """
        return self.carry(vertices, -2) + self.points.offset.astype(vertices.dtype)

    def carry_landmarks(self, scheme: LandmarkScheme, source: Float[np.ndarray, "A 3"]) -> LandmarkScheme:
        """Return the same landmarks on the target.

        Args:
            scheme: of the source.
            source: the template's vertices.
        """
        placed = self.place(source.astype(np.float64))
        _, face, share = closest_points(scheme.points(source.astype(np.float64)), placed, self.target_triangles)
        return replace(scheme, indices=self.target_triangles[face], weights=share, reversed_in_file=False, header={})

    def inverse(self) -> "TopologyMap":
        """Return the map from the target to the source, from the same bending."""
        turned = self.rotation / self.scale  # rows: a vector of the source's frame times it is one of the target's

        def swapped(points: SurfacePoints, offsets: np.ndarray) -> SurfacePoints:
            return replace(points, offset=offsets)

        return replace(
            self,
            source_triangles=self.target_triangles,
            target_triangles=self.source_triangles,
            points=swapped(self.back, self.back.offset @ turned),
            back=swapped(self.points, self.points.offset @ turned),
            scale=1 / self.scale,
            rotation=self.rotation.T.copy(),
            translation=-self.translation @ turned,
        )

    def check(self, source: Int[np.ndarray, "F 3"], target: Int[np.ndarray, "G 3"], where: object) -> None:
        """Check that the map is of two meshes.

        Args:
            source: the source's triangles.
            target: the target's triangles.
            where: the map's file.

        Raises:
            InputError: it is of other topologies; the message says if it is the other way round.
        """
        wanted = topology_hash(source), topology_hash(target)
        own = self.source_topology, self.target_topology
        if wanted == own:
            return
        reverse = wanted == own[::-1]
        raise InputError(
            "The map is of other meshes",
            where=where,
            expected=" to ".join(f"topology {digest[:_DIGITS]}" for digest in wanted),
            got=" to ".join(digest[:_DIGITS] for digest in own) + (", the other way round" if reverse else ""),
            fix="use its inverse, or make a map of these meshes with `gnmreg model map`",
        )
