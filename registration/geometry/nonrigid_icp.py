"""Non-rigid ICP [Amberg 2007] in displacements: a mesh is bent onto another surface, from stiff to soft.

Amberg gives each vertex an affine map and penalises differences of neighbours'; affine motions of the whole are free.
Here the bi-Laplacian of the displacement is penalised, from step to step, with the same free motions and a quarter of
the unknowns: a factorization of 11,460 vertices takes 0.6 s instead of 7.7. Stiffness is a length: what is smaller
keeps its shape. Beside it space is bent: one spline in three dimensions, whose energy also decides where points lie
along the surface. Landmarks decide which of the two is taken.
See docs/algorithms.md, "Maps between topologies".
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy.linalg import cho_factor, cho_solve
from scipy.sparse import csr_matrix, diags
from scipy.sparse.linalg import LinearOperator, SuperLU, cg, splu

from registration.geometry.closest_point import ClosestPointQuery, barycentric_points
from registration.geometry.large_steps import normalised_laplacian, spacing
from registration.geometry.space_spline import SpaceSpline
from registration.geometry.topology import boundary_vertices, vertex_areas, vertex_normals

_ON_EDGE = 1e-4  # a barycentric weight below it: the closest point lies on the opposite edge
_OUTLIER = 2.0  # times the median residual: landmarks that are farther away count little
_TOLERANCE = 1e-3  # relative, of the linear systems
_MAX_ITERATIONS = 200  # of a linear system
_CENTRES = 500  # of a spline: 2 cm apart on a head
_ROWS = 2000  # vertices that a spline is fitted to
_SLIDING = 1e-7  # weight of distance along the surface, for splines: more of it would hold points where they came first
_AFFINE_FLOOR = 1e-12  # m^2: makes a spline without data or landmarks nothing
_ERRORS = 2.0  # standard errors of the mean: gains below it may be chance
_FLOOR = 1e-6  # pull of every vertex to where it is, of the weight of data: parts without data have a solution


@dataclass(frozen=True, kw_only=True)
class Rung:
    """One step of the ladder of stiffness."""

    length_m: float  # displacements may vary over this length
    landmarks: float  # weight of a landmark, in square centimetres of skin
    reach_m: float  # closest points that are farther away are rejected
    facing: float  # least cosine between the normals
    whole: bool = False  # also with what is left out later, as ears: a stiff mesh cannot fold there, and they anchor it


# Reach, m, and facing. Twelve splines: eight of falling stiffness, then points come to rest along the surface.
_LIMITS = ((0.050, 0.3), (0.032, 0.5), (0.020, 0.5), (0.012, 0.5)) + 8 * ((0.008, 0.5),)
_LENGTHS = np.r_[np.geomspace(0.060, 0.005, 8), np.full(4, 0.005)]
_LANDMARKS = np.r_[np.geomspace(10, 0.003, 8), np.full(4, 0.003)]
SPLINES = tuple(
    Rung(length_m=float(length), landmarks=float(weight), reach_m=reach, facing=facing, whole=True)
    for length, weight, (reach, facing) in zip(_LENGTHS, _LANDMARKS, _LIMITS, strict=True)
)
LADDER = (
    Rung(length_m=0.150, landmarks=30.0, reach_m=0.050, facing=0.3, whole=True),
    Rung(length_m=0.080, landmarks=20.0, reach_m=0.032, facing=0.5, whole=True),
    Rung(length_m=0.050, landmarks=10.0, reach_m=0.020, facing=0.5, whole=True),
    Rung(length_m=0.030, landmarks=5.0, reach_m=0.012, facing=0.5, whole=True),
    Rung(length_m=0.020, landmarks=2.0, reach_m=0.008, facing=0.5, whole=True),
    Rung(length_m=0.012, landmarks=1.0, reach_m=0.008, facing=0.5),
)


@dataclass(frozen=True, kw_only=True)
class IcpSettings:
    """How a mesh is bent."""

    splines: tuple[Rung, ...] = SPLINES  # one step each: space is bent; then the surface, on the ladder's last rung
    ladder: tuple[Rung, ...] = LADDER  # the surface alone is bent
    steps: int = 3  # of each rung of the ladder
    tangential: float = 0.001  # weight of distance along the surface, on the ladder; that across it has 1
    rounds: int = 10  # point to plane, at the end
    round_tangential: float = 0.1
    round_lengths_m: tuple[float, float] = (0.004, 0.0005)  # of the first and the last; geometric between them


@dataclass(frozen=True, kw_only=True, eq=False)
class Hits:
    """The closest points of a surface, one per query."""

    distance: Float[np.ndarray, "P"]
    face: Int[np.ndarray, "P"]
    barycentric: Float[np.ndarray, "P 3"]
    points: Float[np.ndarray, "P 3"]
    normals: Float[np.ndarray, "P 3"]  # interpolated, unit or zero
    inside: Bool[np.ndarray, "P"]  # not where the surface ends
    usable: Bool[np.ndarray, "P"]  # nor on a face that is left out


class Surface:
    """A triangle mesh that others are bent onto; metres."""

    def __init__(
        self,
        vertices: Float[np.ndarray, "V 3"],
        triangles: Int[np.ndarray, "F 3"],
        members: Bool[np.ndarray, "V"] | None = None,
    ):
        """Build the tree. Faces of the hits are rows of `triangles`; those with a vertex off `members` are left out."""
        self.vertices, self.triangles = vertices.astype(np.float64), triangles
        self._members = np.ones(len(triangles), bool) if members is None else members[triangles].all(1)
        self._query = ClosestPointQuery(self.vertices, triangles)
        self._normals = normals(self.vertices, triangles)
        self._border = boundary_vertices(triangles, len(vertices))

    def closest(self, points: Float[np.ndarray, "P 3"]) -> Hits:
        """Find the closest point of each point."""
        distance, face, share = self._query.closest(points)
        across = barycentric_points(self._normals, self.triangles, face, share)
        length = np.linalg.norm(across, axis=1, keepdims=True)
        inside = ~(self._border[self.triangles[face]] | (share < _ON_EDGE)).all(1)
        return Hits(
            distance=distance,
            face=face,
            barycentric=share,
            points=barycentric_points(self.vertices, self.triangles, face, share),
            normals=across / np.maximum(length, 1e-20),
            inside=inside,
            usable=self._members[face] & inside,
        )


def normals(vertices: Float[np.ndarray, "V 3"], triangles: Int[np.ndarray, "F 3"]) -> Float[np.ndarray, "V 3"]:
    """Compute unit vertex normals; zero at vertices without area."""
    return vertex_normals(torch.as_tensor(vertices), torch.as_tensor(triangles.astype(np.int64))).numpy()


@dataclass(frozen=True, kw_only=True, eq=False)
class Bent:
    """A mesh that is bent, in the frame of the surface; metres. L landmarks."""

    vertices: Float[np.ndarray, "V 3"]
    triangles: Int[np.ndarray, "F 3"]
    data: Bool[np.ndarray, "V"]  # vertices that are drawn to the surface; the others follow
    whole: Bool[np.ndarray, "V"]  # likewise, on rungs for the whole
    landmarks: csr_matrix  # (L, V): weights of the vertices
    marks: Float[np.ndarray, "L 3"]  # where they belong
    trust: Float[np.ndarray, "L"]  # weights relative to one another

    @cached_property
    def areas(self) -> Float[np.ndarray, "V"]:
        """Area of each vertex, metres squared; never zero."""
        areas = vertex_areas(self.vertices, self.triangles)
        return np.maximum(areas, 1e-3 * areas.mean())

    @cached_property
    def stiffness(self) -> csr_matrix:
        """Second differences, scaled so that the sum of squares is the integral of |Lap d|^2; (V, V)."""
        size = spacing(self.triangles, self.vertices)
        # For a unit second derivative the normalised Laplacian of a regular triangulation gives h^2 / 4.
        return diags(np.sqrt(self.areas) * 4 / size**2) @ normalised_laplacian(self.triangles, len(self.vertices))

    @cached_property
    def energy(self) -> csr_matrix:
        """The matrix of the energy of second differences, (V, V), for a length of 1 m."""
        return (self.stiffness.T @ self.stiffness).tocsr()


def bend(mesh: Bent, surface: Surface, settings: IcpSettings) -> Float[np.ndarray, "V 3"]:
    """Bend a mesh onto a surface.

    Args:
        mesh: roughly aligned with the surface.
        surface: what its data vertices are drawn to. Closest points at its border, on faces that are left out, beyond
            the reach, or with another direction are rejected.
        settings: splines, the ladder, and the rounds after it.

    Returns:
        The bent vertices.
    """
    bent = _bent_surface(mesh, surface, mesh.vertices, settings.ladder, settings)
    if not settings.splines or not len(mesh.trust):
        return bent
    space = _bent_space(mesh, surface, settings.splines)
    space = _bent_surface(mesh, surface, space, settings.ladder[-1:], settings)
    return space if _nearer(mesh, space, bent) else bent


def _bent_surface(
    mesh: Bent, surface: Surface, bent: Float[np.ndarray, "V 3"], ladder: tuple[Rung, ...], settings: IcpSettings
) -> Float[np.ndarray, "V 3"]:
    """Go down the ladder, then the rounds without landmarks."""
    for rung in ladder:
        data = mesh.whole if rung.whole else mesh.data
        system = _System.of(mesh, rung.length_m, data, rung.landmarks * _trust(mesh, bent))
        for _ in range(settings.steps):
            bent = bent + system.step(bent, surface, rung, settings.tangential)
    for length_m in np.geomspace(*settings.round_lengths_m, settings.rounds):
        system = _System.of(mesh, length_m, mesh.data, 0 * mesh.trust)
        bent = bent + system.step(bent, surface, ladder[-1], settings.round_tangential)
    return bent


def _nearer(mesh: Bent, one: Float[np.ndarray, "V 3"], other: Float[np.ndarray, "V 3"]) -> bool:
    """Whether landmarks come nearer to where they belong in `one`, beyond what their own errors explain.

    The errors are common to both, so that the differences are compared, pair by pair.
    """
    residuals = [np.linalg.norm(mesh.landmarks @ bent - mesh.marks, axis=1) for bent in (one, other)]
    share, gain = mesh.trust / mesh.trust.sum(), residuals[1] - residuals[0]
    mean = share @ gain
    return bool(mean > _ERRORS * np.sqrt(np.square(share) @ np.square(gain - mean)))


def _bent_space(mesh: Bent, surface: Surface, rungs: tuple[Rung, ...]) -> Float[np.ndarray, "V 3"]:
    """Bend space with a mesh: the sum of all steps is one spline, from step to step a softer one.

    Distances along the surface cost next to nothing, so that points slide to where space is bent least.
    """
    bent = mesh.vertices
    spline = SpaceSpline.of(mesh.vertices, _CENTRES)
    marked, rng = np.asarray(mesh.landmarks @ spline.values), np.random.default_rng(0)
    count = spline.values.shape[1]
    for rung in rungs:
        hits = surface.closest(bent)
        data = mesh.whole if rung.whole else mesh.data
        kept = np.flatnonzero(data & _kept(hits, normals(bent, mesh.triangles), rung))
        rows = rng.choice(kept, min(_ROWS, len(kept)), replace=False)
        area = mesh.areas[rows] * mesh.areas[kept].sum() / mesh.areas[rows].sum()
        fields, across = spline.values[rows], hits.normals[rows]
        goal, weight = (hits.points - mesh.vertices)[rows], 1e-4 * rung.landmarks * _trust(mesh, bent)
        pull = _SLIDING * goal + (1 - _SLIDING) * across * np.einsum("rc,rc->r", across, goal)[:, None]
        right = fields.T @ (area[:, None] * pull)
        right += marked.T @ (weight[:, None] * (mesh.marks - mesh.landmarks @ mesh.vertices))
        own = (marked.T * weight) @ marked + np.diag(rung.length_m**5 * spline.energy + _AFFINE_FLOOR)
        matrix = np.empty((3, count, 3, count))
        for i, j in ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2)):
            coupling = area * ((1 - _SLIDING) * across[:, i] * across[:, j] + _SLIDING * (i == j))
            block = fields.T @ (coupling[:, None] * fields) + own * (i == j)
            matrix[i, :, j], matrix[j, :, i] = block, block.T
        solution = cho_solve(cho_factor(matrix.reshape(3 * count, -1), overwrite_a=True), right.T.ravel())
        bent = mesh.vertices + spline.values @ solution.reshape(3, count).T
    return bent


def _trust(mesh: Bent, bent: Float[np.ndarray, "V 3"]) -> Float[np.ndarray, "L"]:
    """The landmarks' weights by Geman and McClure's function: some mark an outline, and lie elsewhere on each head."""
    if not len(mesh.trust):
        return mesh.trust
    residual = np.linalg.norm(mesh.landmarks @ bent - mesh.marks, axis=1)
    usual = _OUTLIER * float(np.median(residual)) + 1e-9
    return mesh.trust / np.square(1 + np.square(residual / usual))


def _kept(hits: Hits, direction: Float[np.ndarray, "V 3"], rung: Rung) -> Bool[np.ndarray, "V"]:
    facing = np.einsum("vc,vc->v", hits.normals, direction) > rung.facing
    return facing & (hits.inside if rung.whole else hits.usable) & (hits.distance < rung.reach_m)


@dataclass(frozen=True, kw_only=True, eq=False)
class _System:
    """The normal equations of one stiffness. They differ from step to step by which vertices have data."""

    mesh: Bent
    data: Bool[np.ndarray, "V"]
    marked: csr_matrix  # (V, L): the landmarks' weights, transposed, times those of their squares
    regular: csr_matrix  # (V, V), of each coordinate
    factor: SuperLU  # with data at all vertices that may have some: preconditions all steps

    @classmethod
    def of(
        cls, mesh: Bent, length_m: float, data: Bool[np.ndarray, "V"], landmarks: Float[np.ndarray, "L"]
    ) -> "_System":
        marked = (mesh.landmarks.T @ diags(1e-4 * landmarks)).tocsr()
        regular = length_m**4 * mesh.energy + _FLOOR * diags(mesh.areas)
        if landmarks.any():
            regular = regular + marked @ mesh.landmarks
        pulled = (regular + diags(0.4 * mesh.areas * data)).tocsc()
        factor = splu(pulled, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
        return cls(mesh=mesh, data=data, marked=marked, regular=regular.tocsr(), factor=factor)

    def step(
        self, now: Float[np.ndarray, "V 3"], surface: Surface, rung: Rung, tangential: float
    ) -> Float[np.ndarray, "V 3"]:
        """Find displacements d: min sum a ((n (d - t))^2 + s |d - t|^2) + landmarks + the energy of d.

        Only what is added is smooth, so that distances go to zero from step to step.
        """
        hits = surface.closest(now)
        kept = self.data & _kept(hits, normals(now, self.mesh.triangles), rung)
        weight, across, shape = (self.mesh.areas * kept)[:, None], hits.normals, now.shape

        def data(d: np.ndarray) -> np.ndarray:
            return weight * ((1 - tangential) * across * (across * d).sum(1, keepdims=True) + tangential * d)

        def product(flat: np.ndarray) -> np.ndarray:
            d = flat.reshape(shape)
            return np.asarray(self.regular @ d + data(d)).ravel()

        right = data(hits.points - now) + self.marked @ (self.mesh.marks - self.mesh.landmarks @ now)
        solution, _ = cg(
            LinearOperator((now.size, now.size), product, dtype=np.float64),
            np.asarray(right).ravel(),
            rtol=_TOLERANCE,
            maxiter=_MAX_ITERATIONS,
            M=LinearOperator((now.size, now.size), lambda r: self.factor.solve(r.reshape(shape)).ravel(), np.float64),
        )
        return np.asarray(solution).reshape(shape)
