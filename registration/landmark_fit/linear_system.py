"""Normal equations with an arrow's shape: blocks of frames, coupled to their neighbours, and unknowns of all frames.

Frames are eliminated first (Schur complement): with a temporal prior their blocks form a block tridiagonal matrix,
without one they are independent.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float
from scipy.linalg import cho_factor, cho_solve, cholesky, solve_triangular

_FLOOR = 1e-12  # of the diagonal, relative to its largest element: what nothing determines stays where it is
_MAX_GROWTH = 0.7  # of the logarithm of a focal length in one step


class NotPositive(Exception):
    """The matrix is not positive definite."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Coordinates:
    """Unknowns in which the problem is closer to linear: logarithms s of focal lengths change distances too.

    A step (y_f, s) is the step (y_f + along_f (exp(s) - 1), s + within (exp(s) - 1)) in the unknowns before.
    """

    along: Float[np.ndarray, "F n m"]  # of shared unknowns, in those of the frames
    within: Float[np.ndarray, "m m"]

    def applied(self, system: "ArrowSystem") -> "ArrowSystem":
        """The system of steps in these unknowns."""
        columns = np.flatnonzero(np.abs(self.along).max((0, 1), initial=0) > 0)
        if not len(columns):
            return system
        D, P = self.along[:, :, columns], np.eye(len(self.within)) + self.within
        carried = system.local @ D  # the local matrix times the change of the frames
        if system.neighbours is not None:
            carried[:-1] += system.neighbours @ D[1:]
            carried[1:] += system.neighbours.T @ D[:-1]
        mixed = system.mixed @ P
        between = np.einsum("fnk,fnm->km", D, mixed, optimize=True)
        shared = P.T @ system.shared @ P
        shared[columns] += between
        shared[:, columns] += between.T
        shared[np.ix_(columns, columns)] += np.einsum("fnk,fnl->kl", D, carried, optimize=True)
        gradient = P.T @ system.shared_gradient
        gradient[columns] += np.einsum("fnk,fn->k", D, system.local_gradient, optimize=True)
        mixed[:, :, columns] += carried
        return replace(system, mixed=mixed, shared=shared, shared_gradient=gradient)

    def undone(self, local: np.ndarray, shared: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The step in the unknowns before."""
        growth = np.expm1(np.clip(shared, -_MAX_GROWTH, _MAX_GROWTH))
        return local + self.along @ growth, shared + self.within @ growth


@dataclass(frozen=True, kw_only=True, eq=False)
class ArrowSystem:
    """H x = -g for n unknowns of each of F frames and m shared ones."""

    local: Float[np.ndarray, "F n n"]
    neighbours: Float[np.ndarray, "n n"] | None  # block of each frame and the next; None: zero
    mixed: Float[np.ndarray, "F n m"]
    shared: Float[np.ndarray, "m m"]
    local_gradient: Float[np.ndarray, "F n"]
    shared_gradient: Float[np.ndarray, "m"]
    local_scale: Float[np.ndarray, "n"]  # what damping adds to the diagonal, times its strength
    shared_scale: Float[np.ndarray, "m"]

    def step(self, damping: float) -> tuple[Float[np.ndarray, "F n"], Float[np.ndarray, "m"]]:
        """Return x of the system whose diagonal is increased by damping times the scales. Raises NotPositive."""
        factors = _Factors(self, damping)
        right = np.concatenate([self.mixed, self.local_gradient[..., None]], 2)
        solved = factors.solve(right)
        reduced = _damped(self.shared, damping * self.shared_scale) - np.einsum(
            "fnm,fnk->mk", self.mixed, solved[..., :-1], optimize=True
        )
        gradient = self.shared_gradient - np.einsum("fnm,fn->m", self.mixed, solved[..., -1], optimize=True)
        shared = -_solved(reduced, gradient)
        local = -solved[..., -1] - solved[..., :-1] @ shared
        return local, shared

    def dense(self) -> tuple[Float[np.ndarray, "K K"], Float[np.ndarray, "K"]]:
        """The matrix and the gradient as a whole, frames first: for comparison."""
        frames, n, m = self.mixed.shape
        matrix = np.zeros((frames * n + m, frames * n + m))
        for f in range(frames):
            own = slice(f * n, f * n + n)
            matrix[own, own] = self.local[f]
            matrix[own, frames * n :] = self.mixed[f]
            matrix[frames * n :, own] = self.mixed[f].T
            if self.neighbours is not None and f + 1 < frames:
                following = slice(f * n + n, f * n + 2 * n)
                matrix[own, following] = self.neighbours
                matrix[following, own] = self.neighbours.T
        matrix[frames * n :, frames * n :] = self.shared
        return matrix, np.concatenate([self.local_gradient.ravel(), self.shared_gradient])

    def predicted(self, local: Float[np.ndarray, "F n"], shared: Float[np.ndarray, "m"]) -> float:
        """Change of the quadratic model, g x + x H x / 2."""
        image = np.einsum("fij,fj->fi", self.local, local) + self.mixed @ shared
        if self.neighbours is not None:
            image[:-1] += local[1:] @ self.neighbours.T
            image[1:] += local[:-1] @ self.neighbours
        both = self.shared @ shared + np.einsum("fnm,fn->m", self.mixed, local)
        linear = (self.local_gradient * local).sum() + self.shared_gradient @ shared
        return float(linear + ((image * local).sum() + both @ shared) / 2)

    def covariances(self) -> tuple[Float[np.ndarray, "m m"], Iterator[tuple[np.ndarray, np.ndarray]]]:
        """Blocks of the inverse: the shared one, and of each frame from the last its own and that with the shared."""
        factors = _Factors(self, 0.0)
        solved = factors.solve(self.mixed)
        shared = _inverse(self.shared - np.einsum("fnm,fnk->mk", self.mixed, solved, optimize=True))
        return shared, self._local_covariances(factors, solved, shared)

    def _local_covariances(self, factors: "_Factors", solved: np.ndarray, shared: np.ndarray) -> Iterator:
        following: np.ndarray | None = None
        for f in reversed(range(len(self.local))):
            own = cho_solve((factors.lower[f], True), np.eye(self.local.shape[1]))
            if following is not None and self.neighbours is not None:
                carried = own @ self.neighbours
                own = own + carried @ following @ carried.T
            following = own
            mixed = -solved[f] @ shared
            yield own - mixed @ solved[f].T, mixed


class _Factors:
    """The Cholesky factors of the frames' block tridiagonal matrix."""

    def __init__(self, system: ArrowSystem, damping: float):
        self._neighbours = system.neighbours
        self.lower: list[np.ndarray] = []
        for f, block in enumerate(system.local):
            damped = _damped(block, damping * system.local_scale)
            if f and system.neighbours is not None:
                half = solve_triangular(self.lower[-1], system.neighbours, lower=True)
                damped = damped - half.T @ half
            try:
                self.lower.append(cholesky(damped, lower=True))
            except (np.linalg.LinAlgError, ValueError):
                raise NotPositive from None

    def solve(self, right: Float[np.ndarray, "F n k"]) -> Float[np.ndarray, "F n k"]:
        if self._neighbours is None:
            return np.stack([cho_solve((L, True), b) for L, b in zip(self.lower, right, strict=True)])
        forward: list[np.ndarray] = []
        for f, lower in enumerate(self.lower):
            b = right[f]
            if f:
                b = b - self._neighbours.T @ forward[-1]
            forward.append(cho_solve((lower, True), b))
        for f in reversed(range(len(forward) - 1)):
            forward[f] = forward[f] - cho_solve((self.lower[f], True), self._neighbours @ forward[f + 1])
        return np.stack(forward)


def _damped(matrix: np.ndarray, added: np.ndarray) -> np.ndarray:
    result = matrix.copy()
    if len(added):
        result[np.diag_indices_from(result)] += added + _FLOOR * np.diag(matrix).max()
    return result


def _solved(matrix: np.ndarray, right: np.ndarray) -> np.ndarray:
    if not len(right):
        return right.copy()
    scale = 1 / np.sqrt(np.maximum(np.diag(matrix), 1e-300))  # radians, metres and coefficients differ by magnitudes
    try:
        return scale * cho_solve(cho_factor(matrix * scale[:, None] * scale), scale * right)
    except (np.linalg.LinAlgError, ValueError):
        raise NotPositive from None


def _inverse(matrix: np.ndarray) -> np.ndarray:
    if not len(matrix):
        return matrix.copy()
    scale = 1 / np.sqrt(np.maximum(np.diag(matrix), 1e-300))
    scaled = matrix * scale[:, None] * scale
    try:
        inverse = cho_solve(cho_factor(scaled), np.eye(len(matrix)))
    except (np.linalg.LinAlgError, ValueError):
        inverse = np.linalg.pinv(scaled, hermitian=True)
    return inverse * scale[:, None] * scale
