"""Both stages of [GNM, Generalization to Novel Shapes], by least squares: a model's best fit to a registered mesh, then
to the raw scan by closest points. Without regularization, without scale, and without alignment afterwards: the rigid
motion is part of the fit.

Each stage linearizes its squared distances (`Linearized`); `least_squares` takes the minimum of that, `face_adam` runs
the paper's optimizer on it.
"""

from dataclasses import dataclass, field, replace
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.linalg import cho_factor, cho_solve
from scipy.sparse import csr_array

from coregister.evaluate.face_model import FaceModel
from coregister.evaluate.linear_fit import solve_normal_equations, twist_to_matrix
from registration.frames import MM_PER_M, transform_points
from registration.geometry.closest_point import barycentric_points, closest_points
from registration.geometry.rigid import align, motion_fields

_TOLERANCE_M = 1e-8  # maximum motion of a vertex in the last step of stage 1
_MAX_STEPS = 60
_MIN_GAIN = 1e-4  # of the mean squared distance: a step of stage 2 that gains less is the last
_EPSILON_M2 = 1e-16  # mean squared distance below which the scan lies on the surface
_TOUCHING_M = 1e-7  # nearer points have no direction; the face's normal replaces it
_FIRST_DAMPING, _MIN_DAMPING, _MAX_DAMPING = 1e-4, 1e-6, 1e6  # of the scaled normal equations, whose diagonal is one


@dataclass(frozen=True, kw_only=True)
class FaceFit:
    """Parameters of a model that was fitted to a face."""

    coefficients: Float[np.ndarray, "K"]
    angles: Float[np.ndarray, "A 3"]  # rotation vectors of the free joints
    T_model_world: Float[np.ndarray, "4 4"]  # aligns the target with the model
    converged: bool = True
    steps: int = 0

    def moved(self, step: Float[np.ndarray, "N"]) -> "FaceFit":
        """Return the fit after a step of the coefficients, the angles, and the twist of the target."""
        count, last = len(self.coefficients), len(step) - 6
        return replace(
            self,
            coefficients=self.coefficients + step[:count],
            angles=self.angles + step[count:last].reshape(-1, 3),
            T_model_world=twist_to_matrix(step[last:]) @ self.T_model_world,
        )


@dataclass(frozen=True, kw_only=True)
class Linearized:
    """Half the gradient and the Gauss-Newton matrix of the mean squared distance at a fit, m^2."""

    cost: float
    matrix: Float[np.ndarray, "N N"]  # of coefficients, angles, twist
    gradient: Float[np.ndarray, "N"]


@runtime_checkable
class Stage(Protocol):
    """A target, and the model that is fitted to it."""

    def cost(self, fit: FaceFit) -> float:
        """Return the mean squared distance, m^2."""
        ...

    def linearize(self, fit: FaceFit) -> Linearized:
        """Return its quadratic approximation."""
        ...


@dataclass(frozen=True, kw_only=True, eq=False)
class RegisteredStage:
    """Stage 1: the vertices of a registered mesh that correspond to some of the model's."""

    model: FaceModel
    rows: Bool[np.ndarray, "P"]  # the model's vertices that have a correspondence
    target: Float[np.ndarray, "Q 3"]  # metres, any frame

    def start(self) -> FaceFit:
        """Return the model at rest, aligned."""
        pose = align(self.target[None], self.model.rest[self.rows], np.ones((1, len(self.target))))[0]
        return FaceFit(
            coefficients=np.zeros(len(self.model.basis)), angles=np.zeros((self.model.angles, 3)), T_model_world=pose
        )

    def residual(self, fit: FaceFit) -> Float[np.ndarray, "Q 3"]:
        """Return the vectors from the model's vertices to the aligned target, metres."""
        shape = self.model.shape(fit.coefficients, fit.angles)[self.rows]
        return transform_points(fit.T_model_world, self.target) - shape

    def cost(self, fit: FaceFit) -> float:
        return float((self.residual(fit) ** 2).sum(1).mean())

    def linearize(self, fit: FaceFit) -> Linearized:
        residual = self.residual(fit).ravel()
        fields = motion_fields(transform_points(fit.T_model_world, self.target)).reshape(6, -1)
        if self.model.articulation is None:
            flat, products = self.model.products(self.rows)
        else:
            columns = self.model.derivative(fit.coefficients, fit.angles)
            flat = columns.reshape(-1, 3, columns.shape[1])[self.rows].reshape(-1, columns.shape[1]).T
            products = flat @ flat.T
        cross = -flat @ fields.T
        count = len(self.target)
        return Linearized(
            cost=float(residual @ residual) / count,
            matrix=np.block([[products, cross], [cross.T, fields @ fields.T]]) / count,
            gradient=np.concatenate([-flat @ residual, fields @ residual]) / count,
        )


@dataclass(frozen=True, kw_only=True, eq=False)
class _Closest:
    """The closest points of the surface, in the model's frame."""

    shape: Float[np.ndarray, "P 3"]
    points: Float[np.ndarray, "N 3"]
    distance: Float[np.ndarray, "N"]
    face: Int[np.ndarray, "N"]
    barycentric: Float[np.ndarray, "N 3"]


@dataclass(frozen=True, kw_only=True, eq=False)
class ScanStage:
    """Stage 2: points of the raw scan, each against the closest point of the model's surface.

    To first order a distance changes only along its own direction, so that one row per point is enough.
    """

    model: FaceModel
    points: Float[np.ndarray, "N 3"]  # metres, any frame
    _last: list[tuple[FaceFit, "_Closest"]] = field(default_factory=list, init=False, repr=False)

    def distances(self, fit: FaceFit, points: Float[np.ndarray, "M 3"] | None = None) -> Float[np.ndarray, "M"]:
        """Return the distances of the points, or of others in their frame, from the surface; metres."""
        aligned = transform_points(fit.T_model_world, self.points if points is None else points)
        return closest_points(aligned, self.model.shape(fit.coefficients, fit.angles), self.model.triangles)[0]

    def cost(self, fit: FaceFit) -> float:
        return float((self._closest(fit).distance ** 2).mean())

    def _closest(self, fit: FaceFit) -> "_Closest":
        """The closest points at a fit; the last ones are kept, since an accepted step is linearized next."""
        if not self._last or self._last[0][0] is not fit:
            shape, points = (
                self.model.shape(fit.coefficients, fit.angles),
                transform_points(fit.T_model_world, self.points),
            )
            distance, face, barycentric = closest_points(points, shape, self.model.triangles)
            found = _Closest(shape=shape, points=points, distance=distance, face=face, barycentric=barycentric)
            self._last[:] = [(fit, found)]
        return self._last[0][1]

    def linearize(self, fit: FaceFit) -> Linearized:
        found, triangles = self._closest(fit), self.model.triangles
        shape, aligned, distance, face = found.shape, found.points, found.distance, found.face
        barycentric = found.barycentric
        residual = aligned - barycentric_points(shape, triangles, face, barycentric)
        a, b, c = (shape[triangles[face, k]] for k in range(3))
        normal = np.cross(b - a, c - a)
        normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-300)
        unit = residual / np.maximum(distance, _TOUCHING_M)[:, None]
        direction = np.where(distance[:, None] > _TOUCHING_M, unit, normal)
        signed = (residual * direction).sum(1)
        rows = self._rows(triangles[face], barycentric, direction, len(shape))
        shape_rows = -(rows @ self.model.derivative(fit.coefficients, fit.angles).astype(np.float32, copy=False))
        motion_rows = np.einsum("kpc,pc->pk", motion_fields(aligned), direction).astype(np.float32)
        jacobian = np.concatenate([shape_rows, motion_rows], 1)
        count = len(aligned)
        return Linearized(
            cost=float(signed @ signed) / count,
            matrix=(jacobian.T @ jacobian).astype(np.float64) / count,
            gradient=(signed.astype(np.float32) @ jacobian).astype(np.float64) / count,
        )

    @staticmethod
    def _rows(corners: np.ndarray, barycentric: np.ndarray, direction: np.ndarray, vertices: int) -> csr_array:
        """The projections of the closest surface points on their directions, as combinations of coordinates."""
        count = len(corners)
        values = (barycentric[:, :, None] * direction[:, None, :]).astype(np.float32)
        columns = 3 * corners[:, :, None] + np.arange(3)
        pointer = np.arange(0, 9 * count + 1, 9)
        return csr_array((values.ravel(), columns.ravel(), pointer), shape=(count, 3 * vertices))


def fit_registered(stage: RegisteredStage, active: Int[np.ndarray, "k"] | None = None) -> FaceFit:
    """Return the best fit of stage 1: Gauss-Newton steps until no vertex moves by more than 10 nanometres.

    Args:
        stage: model and target.
        active: components that may be used; None: all.
    """
    fit = stage.start()
    if stage.model.articulation is not None:
        return least_squares(stage, fit, active)
    flat, inverse = stage.model.normal_inverse(stage.rows, active)
    for number in range(1, _MAX_STEPS + 1):
        # With the motion given, the best coefficients are linear in it; what they cannot follow decides the motion.
        aligned = transform_points(fit.T_model_world, stage.target)
        wanted = np.concatenate([stage.residual(fit).reshape(1, -1), motion_fields(aligned).reshape(6, -1)])
        followed = inverse @ (flat @ wanted.T)
        left = wanted - followed.T @ flat
        twist = -solve_normal_equations(left[1:] @ left[1:].T, left[1:] @ left[:1].T)[:, 0]
        step = np.concatenate([followed @ np.concatenate([[1.0], twist]), twist])
        moved = fit.moved(step)
        before, after = (stage.model.shape(f.coefficients, f.angles)[stage.rows] for f in (fit, moved))
        change = max(np.abs(after - before).max(), np.abs(twist @ wanted[1:]).max())
        fit = moved
        if change < _TOLERANCE_M:
            return replace(fit, converged=True, steps=number)
    return replace(fit, converged=False, steps=_MAX_STEPS)


def least_squares(stage: Stage, start: FaceFit, active: Int[np.ndarray, "k"] | None = None) -> FaceFit:
    """Return the best fit by Levenberg-Marquardt steps [Marquardt 1963], until a step gains less than 0.01 %.

    Args:
        stage: what to fit.
        start: where to start.
        active: components that may change; None: all.
    """
    fit, damping = start, _FIRST_DAMPING
    count = len(start.coefficients)
    free = np.arange(count) if active is None else active
    free = np.concatenate([free, np.arange(count, count + start.angles.size + 6)])
    for number in range(1, _MAX_STEPS + 1):
        now = stage.linearize(fit)
        if now.cost < _EPSILON_M2:
            return replace(fit, converged=True, steps=number)
        while True:
            step = np.zeros(len(now.gradient))
            step[free] = -_damped_solution(now.matrix[np.ix_(free, free)], now.gradient[free], damping)
            candidate = fit.moved(step)
            cost = stage.cost(candidate)
            if cost < now.cost:
                break
            damping *= 10
            if damping > _MAX_DAMPING:  # not even the shortest step downhill reduces the cost: this is the minimum
                return replace(fit, converged=True, steps=number)
        fit, damping = candidate, max(damping / 10, _MIN_DAMPING)
        if 1 - cost / now.cost < _MIN_GAIN:
            return replace(fit, converged=True, steps=number)
    return replace(fit, converged=False, steps=_MAX_STEPS)


def _damped_solution(
    matrix: Float[np.ndarray, "N N"], gradient: Float[np.ndarray, "N"], damping: float
) -> Float[np.ndarray, "N"]:
    squares = np.diag(matrix)
    scale = np.sqrt(np.maximum(squares, 1e-12 * squares.max()))
    scaled = matrix / np.outer(scale, scale) + damping * np.eye(len(scale))
    try:
        return np.asarray(cho_solve(cho_factor(scaled), gradient / scale)) / scale
    except np.linalg.LinAlgError:
        return solve_normal_equations(scaled, (gradient / scale)[:, None])[:, 0] / scale


def distance_mm(stage: ScanStage, fit: FaceFit, points: Float[np.ndarray, "M 3"]) -> Float[np.ndarray, "M"]:
    """Return the distances of points of the scan from the fitted surface, millimetres."""
    return stage.distances(fit, points) * MM_PER_M
