"""The mouth around a tongue: how a model opens it, and how deep a tongue lies in its teeth, palate and skin.

The tongue and the lower teeth are carried by the jaw, as the model's lower-face components move them; a pose of the
tongue is relative to that.
"""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from jaxtyping import Float, Int

from registration.errors import InputError
from registration.frames import MM_PER_M
from registration.geometry.closest_point import ClosestPointQuery, barycentric_points
from registration.geometry.topology import connected_parts
from registration.geometry.winding import Winding, closed
from registration.model import regions
from registration.model.gnm_npz import GNMData

_INCISORS = 6e-3, 8e-3  # metres behind the foremost tooth, and to each side of the median plane
_INSIDE = 0.5  # winding number
_LEAST_LOWERING_MM = 0.1
OBSTACLES = ("teeth and gums", "skin")


@dataclass(frozen=True, kw_only=True, eq=False)
class JawOpening:
    """The lower-face components of a model, and the most probable expression that lowers the lower incisors."""

    basis: Float[np.ndarray, "K V 3"]
    direction: Float[np.ndarray, "K"]  # coefficients for 1 m between the incisors, beyond the template's

    @classmethod
    def of(cls, data: GNMData) -> "JawOpening":
        """Find it: of the expressions that lower the incisors so far, the one with the smallest coefficients.

        Raises:
            InputError: no component of the lower face moves the lower incisors down.
        """
        rows = regions.expression_modes(data).get("lower_face", np.empty(0, np.int64))
        basis = data.expression_basis[rows].astype(np.float64)
        lowering = -basis[:, incisors(data, upper=False), 1].mean(1)
        if len(lowering) == 0 or np.linalg.norm(lowering) * MM_PER_M < _LEAST_LOWERING_MM:
            raise InputError(
                "The model's expressions do not open the jaw",
                where="expression_basis",
                expected="lower-face components that move the lower incisors down",
                got=f"{len(lowering)} components, {np.linalg.norm(lowering) * MM_PER_M:.3f} mm at one deviation of all",
                fix="use a model with expressions of the lower face, or place its teeth first (gnmreg model place)",
            )
        return cls(basis=basis, direction=lowering / (lowering @ lowering))

    def coefficients(self, gap: float, rng: np.random.Generator | None = None, spread: float = 0.0) -> np.ndarray:
        """Return coefficients with a gap between the incisors (m, beyond the template's) and any other expression.

        Args:
            gap: metres.
            rng: of the other coefficients; None: only the jaw opens.
            spread: standard deviation of the other coefficients.
        """
        if rng is None:
            return gap * self.direction
        other = rng.normal(0, spread, len(self.direction))
        unit = self.direction / np.linalg.norm(self.direction)
        return gap * self.direction + other - (other @ unit) * unit

    def of_skin(self, displacement: Float[np.ndarray, "V 3"], data: GNMData) -> Float[np.ndarray, "V 3"]:
        """Return an expression of which only the outer skin counts, teeth and tongue where the jaw carries them.

        The lower-face coefficients are fitted to the outer skin by least squares, with a unit prior at a noise of a
        millimetre; the outer skin itself keeps its displacement.

        Args:
            displacement: of a registered expression from its neutral, in the model's frame, metres.
            data: the model.
        """
        skin = regions.exterior(data)
        rows = np.flatnonzero(skin & (np.abs(self.basis).max((0, 2)) > 1e-6))
        flat = self.basis[:, rows].reshape(len(self.basis), -1) * MM_PER_M
        right = flat @ (displacement[rows].ravel() * MM_PER_M)
        result = self.displacement(np.linalg.solve(flat @ flat.T + np.eye(len(flat)), right))
        result[skin] = displacement[skin]
        return result

    def gap(self, displacement: Float[np.ndarray, "V 3"], data: GNMData) -> float:
        """Return how much farther an expression holds the incisors apart than the template, metres."""
        upper, lower = (displacement[incisors(data, upper=side), 1].mean() for side in (True, False))
        return float(upper - lower)

    def displacement(self, coefficients: Float[np.ndarray, "K"]) -> Float[np.ndarray, "V 3"]:
        """Return the displacements of all vertices, the tongue carried by the jaw."""
        return np.tensordot(coefficients, self.basis, 1)


def incisors(data: GNMData, *, upper: bool) -> Int[np.ndarray, "M"]:
    """Return the vertices of the front teeth of one jaw, within 8 mm of the median plane."""
    lower = regions.lower_teeth(data)
    teeth = np.flatnonzero(regions.teeth(data) & (~lower if upper else lower))
    points = data.template_vertex_positions[teeth]
    depth, side = _INCISORS
    return teeth[(points[:, 2] > points[:, 2].max() - depth) & (np.abs(points[:, 0]) < side)]


@dataclass(frozen=True, kw_only=True, eq=False)
class Contacts:
    """Planes behind which N vertices of a tongue ought not to lie: normal . x >= level. Metres."""

    rows: Int[np.ndarray, "N"]  # of the tongue's vertices
    normals: Float[np.ndarray, "N 3"]  # out of the obstacle, unit length
    levels: Float[np.ndarray, "N"]

    @classmethod
    def none(cls) -> "Contacts":
        """No planes."""
        return cls(rows=np.empty(0, np.int64), normals=np.empty((0, 3)), levels=np.empty(0))

    def shifted(self, moves: Float[np.ndarray, "T 3"]) -> "Contacts":
        """Return the planes moved by the displacement of each one's vertex, of the tongue's T."""
        return replace(self, levels=self.levels + np.einsum("nc,nc->n", self.normals, moves[self.rows]))

    def with_more(self, other: "Contacts") -> "Contacts":
        """Return the planes of both."""
        return Contacts(
            rows=np.concatenate([self.rows, other.rows]),
            normals=np.concatenate([self.normals, other.normals]),
            levels=np.concatenate([self.levels, other.levels]),
        )


class Mouth:
    """What surrounds the tongue in one expression, prepared for many tongues. Metres, the model's frame."""

    def __init__(self, data: GNMData, vertices: Float[np.ndarray, "V 3"]):
        """Prepare the surfaces.

        Args:
            data: the model.
            vertices: the model's vertices with an expression; those of the tongue are where the jaw carries them.
        """
        self.vertices = np.asarray(vertices, np.float64)
        self.carried = self.vertices[regions.tongue(data)]
        solids = regions.solids(data)
        teeth = solids["teeth"]
        part = connected_parts(teeth)
        self._shells = [_Surface(self.vertices, teeth[part == number]) for number in np.unique(part)]
        near = self._near(solids["skin"])
        self._skin = _Surface(self.vertices, solids["skin"], near)

    def _near(self, triangles: Int[np.ndarray, "F 3"]) -> Int[np.ndarray, "G 3"]:
        """The skin within reach of the tongue, where distances are measured."""
        reach = 0.05
        low, high = self.carried.min(0) - reach, self.carried.max(0) + reach
        centres = self.vertices[triangles].mean(1)
        return triangles[((centres > low) & (centres < high)).all(1)]

    def depths_mm(self, tongue: Float[np.ndarray, "N 3"], *, skin: bool = True) -> dict[str, Float[np.ndarray, "N"]]:
        """Return how deep each vertex of a tongue lies in the teeth with their gums and palate, and in the skin.

        Args:
            tongue: the tongue's vertices in this mouth.
            skin: ask for the skin too: lips, cheeks and the lining.

        Returns:
            By obstacle, in millimetres; 0 outside.
        """
        depths = {OBSTACLES[0]: np.max([shell.depth_mm(tongue) for shell in self._shells], axis=0)}
        if skin:
            depths[OBSTACLES[1]] = self._skin.depth_mm(tongue)
        return depths

    @cached_property
    def resting(self) -> dict[str, Float[np.ndarray, "N"]]:
        """The depths of the tongue as carried by the jaw, which no pose can avoid."""
        return self.depths_mm(self.carried)

    def deepest(self, tongue: Float[np.ndarray, "N 3"], more_than_mm: float) -> "Contacts":
        """Return the vertices of a tongue that lie deeper than as carried by the jaw, and the way out of the obstacle.

        Args:
            tongue: the tongue's vertices in this mouth.
            more_than_mm: deeper by this.
        """
        found = []
        for name, surfaces in ((OBSTACLES[0], self._shells), (OBSTACLES[1], [self._skin])):
            for surface in surfaces:
                rows, outlets = surface.outlets(tongue)
                out = outlets - tongue[rows]
                depth = np.linalg.norm(out, axis=1)
                allowed = self.resting[name][rows] / MM_PER_M
                deep = depth > allowed + more_than_mm / MM_PER_M
                normals = out[deep] / depth[deep, None]
                found.append((rows[deep], normals, np.einsum("nc,nc->n", normals, outlets[deep]) - allowed[deep]))
        rows, normals, levels = (np.concatenate(parts) for parts in zip(*found, strict=True))
        return Contacts(rows=rows, normals=normals, levels=levels)

    def excess_mm(self, tongue: Float[np.ndarray, "N 3"], *, skin: bool = True) -> dict[str, float]:
        """Return by obstacle how much deeper than as carried by the jaw the deepest vertex lies, millimetres."""
        depths = self.depths_mm(tongue, skin=skin)
        return {name: float((depth - self.resting[name]).max(initial=0)) for name, depth in depths.items()}


class _Surface:
    """A closed surface, and the triangles to which depths are measured."""

    def __init__(
        self,
        vertices: Float[np.ndarray, "V 3"],
        triangles: Int[np.ndarray, "F 3"],
        measured: Int[np.ndarray, "G 3"] | None = None,
    ):
        corners = vertices[triangles].reshape(-1, 3)
        self._low, self._high = corners.min(0), corners.max(0)
        self._winding = Winding(*closed(vertices, triangles))
        self._vertices, self._measured = vertices, triangles if measured is None else measured
        self._query = ClosestPointQuery(vertices, self._measured)

    def depth_mm(self, points: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, "N"]:
        depth, inside = np.zeros(len(points)), self._inside(points)
        if len(inside):
            depth[inside] = self._query.closest(points[inside])[0] * MM_PER_M
        return depth

    def outlets(self, points: Float[np.ndarray, "N 3"]) -> tuple[Int[np.ndarray, "M"], Float[np.ndarray, "M 3"]]:
        """Return which points lie inside, and the closest point of the surface for each of these."""
        inside = self._inside(points)
        if not len(inside):
            return inside, np.empty((0, 3))
        _, face, barycentric = self._query.closest(points[inside])
        return inside, barycentric_points(self._vertices, self._measured, face, barycentric)

    def _inside(self, points: Float[np.ndarray, "N 3"]) -> Int[np.ndarray, "M"]:
        boxed = np.flatnonzero(((points > self._low) & (points < self._high)).all(1))
        return boxed[self._winding.numbers(points[boxed]) > _INSIDE]
