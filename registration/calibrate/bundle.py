"""Bundle adjustment: cameras, focal lengths and points that explain image positions best.

Levenberg-Marquardt on the normal equations, points eliminated by the Schur complement [Triggs 2000],
outliers by Cauchy weights. Priors of points, focal lengths and distortion are residuals of their own; what neither
images nor priors determine (the gauge) stays where it was.

A point p of the world lands in view i at c + f d(r) (x / z, y / z), with (x, y, z) = R_i p + t_i, d(r) = 1 + k1 r^2,
r^2 = (x^2 + y^2) / z^2, and f = f_g exp(e_i): the focal length of the view's group times the view's own deviation,
whose prior is the spread of focal lengths within a group.
"""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int
from scipy import sparse
from scipy.spatial.transform import Rotation

_POSE, _OWN = 6, 7  # columns of a view: rotation, translation, and the deviation of its focal length
_GROUP = 2  # columns of a group: logarithm of the focal length, k1
_CAUCHY = 2.0  # standard deviations at which an observation's weight is halved
_GAIN = 1e-6  # relative decrease of the cost below which the adjustment has converged
_CHUNK = 2048  # points that are eliminated at a time
_MIN_DEPTH_M = 1e-3  # points nearer to a camera, or behind it, have no image there


@dataclass(frozen=True, kw_only=True, eq=False)
class Rig:
    """Cameras of N views in G groups that share a focal length. Metres, pixels."""

    rotations: Float[np.ndarray, "N 3 3"]  # camera from world
    translations: Float[np.ndarray, "N 3"]
    centres_px: Float[np.ndarray, "N 2"]  # principal points; known
    group: Int[np.ndarray, "N"]
    focals_px: Float[np.ndarray, "G"]
    k1: Float[np.ndarray, "G"]
    deviation: Float[np.ndarray, "N"]  # logarithm of the view's focal length over its group's

    @property
    def view_focals_px(self) -> Float[np.ndarray, "N"]:
        """The focal length of each view."""
        return self.focals_px[self.group] * np.exp(self.deviation)

    @property
    def positions(self) -> Float[np.ndarray, "N 3"]:
        """The cameras' centres in the world."""
        return -np.einsum("nji,nj->ni", self.rotations, self.translations)

    def moved(self, scale: float, rotation: Float[np.ndarray, "3 3"], shift: Float[np.ndarray, "3"]) -> "Rig":
        """The same cameras in the world p' = scale * rotation @ p + shift."""
        rotations = self.rotations @ rotation.T
        return replace(self, rotations=rotations, translations=scale * self.translations - rotations @ shift)


@dataclass(frozen=True, kw_only=True, eq=False)
class Observations:
    """M image positions of points; the centre of pixel (0, 0) is at (0.5, 0.5)."""

    view: Int[np.ndarray, "M"]
    point: Int[np.ndarray, "M"]
    xy_px: Float[np.ndarray, "M 2"]
    sigma_px: Float[np.ndarray, "M"]  # standard deviation along each axis

    def __len__(self) -> int:
        return len(self.view)

    def where(self, keep: np.ndarray) -> "Observations":
        """Those of a mask or of indices."""
        return Observations(
            view=self.view[keep], point=self.point[keep], xy_px=self.xy_px[keep], sigma_px=self.sigma_px[keep]
        )


@dataclass(frozen=True, kw_only=True, eq=False)
class Priors:
    """What is known besides the images; standard deviations of infinity say nothing, of 0 hold the value."""

    points: Float[np.ndarray, "P 3"]  # expected positions, metres
    point_sigma_m: Float[np.ndarray, "P"]
    focals_px: Float[np.ndarray, "G"]
    focal_sigma: Float[np.ndarray, "G"]  # of the logarithm
    k1_sigma: Float[np.ndarray, "G"] | float = 0.0  # around 0
    deviation_sigma: float = 0.0  # of a view's focal length from its group's, of the logarithm


@dataclass(frozen=True, kw_only=True, eq=False)
class Adjusted:
    """The result of an adjustment."""

    rig: Rig
    points: Float[np.ndarray, "P 3"]  # metres, world
    residuals_px: Float[np.ndarray, "M 2"]  # projected less observed; NaN where the point is behind the camera
    weights: Float[np.ndarray, "M"]  # in [0, 1]: how much an observation counted, 0.5 at two standard deviations
    unit_variance: float  # of weighted residuals over their stated variances: 1 if the stated sigmas are right
    focal_sigma_px: Float[np.ndarray, "G"]  # standard deviations by the normal matrix, times the root of unit_variance
    view_focal_sigma_px: Float[np.ndarray, "N"]
    k1_sigma: Float[np.ndarray, "G"]
    iterations: int
    converged: bool


def project(
    rig: Rig, points: Float[np.ndarray, "P 3"], view: Int[np.ndarray, "M"], point: Int[np.ndarray, "M"]
) -> Float[np.ndarray, "M 2"]:
    """Return where points appear in views, px; NaN behind the camera."""
    local = np.einsum("mij,mj->mi", rig.rotations[view], points[point]) + rig.translations[view]
    front = local[:, 2] > _MIN_DEPTH_M
    ray = local[:, :2] / np.where(front, local[:, 2], np.nan)[:, None]
    stretch = 1 + rig.k1[rig.group[view]] * (ray**2).sum(1)
    return rig.centres_px[view] + (rig.view_focals_px[view] * stretch)[:, None] * ray


def adjust(
    rig: Rig,
    points: Float[np.ndarray, "P 3"],
    observations: Observations,
    priors: Priors,
    *,
    max_iterations: int = 60,
) -> Adjusted:
    """Adjust cameras, focal lengths and points.

    Args:
        rig: the start.
        points: the start, metres, world.
        observations: of the points.
        priors: of points, focal lengths and distortion.
        max_iterations: steps that are tried at most.

    Returns:
        The adjusted cameras and points, residuals and standard deviations. Views and points without observations keep
        their start, unless a prior moves them.
    """
    damping, done, converged = 1e-4, 0, False
    cost = _cost(rig, points, observations, priors)
    for done in range(1, max_iterations + 1):  # noqa: B007 - its last value is reported
        system = _System(rig, points, observations, priors)
        while True:
            trial_rig, trial_points = system.step(damping)
            trial = _cost(trial_rig, trial_points, observations, priors)
            if trial < cost or damping > 1e8:
                break
            damping *= 8
        if not trial < cost:
            converged = True
            break
        converged = cost - trial < _GAIN * cost
        rig, points, cost, damping = trial_rig, trial_points, trial, max(damping / 8, 1e-12)
        if converged:
            break
    return _result(rig, points, observations, priors, done, converged)


def _residuals(rig: Rig, points: np.ndarray, observations: Observations) -> tuple[np.ndarray, np.ndarray]:
    """Residuals in px and squared lengths in standard deviations; infinite behind the camera."""
    residual = project(rig, points, observations.view, observations.point) - observations.xy_px
    squared = (residual**2).sum(1) / observations.sigma_px**2
    return residual, np.where(np.isfinite(squared), squared, np.inf)


def _prior_residuals(rig: Rig, points: np.ndarray, priors: Priors) -> list[np.ndarray]:
    """Residuals of the priors in standard deviations."""
    return [
        (points - priors.points) * _inverse(priors.point_sigma_m)[:, None],
        np.log(rig.focals_px / priors.focals_px) * _inverse(priors.focal_sigma),
        rig.k1 * _inverse(np.asarray(priors.k1_sigma, np.float64)),
        rig.deviation * _inverse(np.array(priors.deviation_sigma)),
    ]


def _inverse(sigma: np.ndarray) -> np.ndarray:
    """1 / sigma, 0 for sigmas of 0 and infinity: what is held has no residual."""
    return np.where((sigma > 0) & np.isfinite(sigma), 1 / np.where(sigma > 0, sigma, 1.0), 0.0)


def _cost(rig: Rig, points: np.ndarray, observations: Observations, priors: Priors) -> float:
    squared = _residuals(rig, points, observations)[1]
    # A point behind a camera costs as much as one that is a thousand standard deviations off.
    robust = _CAUCHY**2 * np.log1p(np.minimum(squared, 1e6) / _CAUCHY**2)
    return float(robust.sum() + sum((part**2).sum() for part in _prior_residuals(rig, points, priors)))


def _weights(squared: np.ndarray) -> np.ndarray:
    return np.where(np.isfinite(squared), 1 / (1 + np.minimum(squared, 1e6) / _CAUCHY**2), 0.0)


class _System:
    """The normal equations at one state; columns of the cameras: views first, then groups."""

    def __init__(self, rig: Rig, points: np.ndarray, observations: Observations, priors: Priors) -> None:
        self._rig, self._points, self._priors = rig, points, priors
        residual, squared = _residuals(rig, points, observations)
        weight = np.sqrt(_weights(squared)) / observations.sigma_px
        seen = weight > 0
        residual, weight, kept = residual[seen] * weight[seen, None], weight[seen], observations.where(seen)
        cameras, structure = self._jacobians(kept, weight)
        columns = _OWN * len(rig.group) + _GROUP * len(rig.focals_px)
        views = kept.view
        own = _OWN * np.arange(len(rig.group))[:, None] + np.arange(_OWN)
        shared = _OWN * len(rig.group) + _GROUP * rig.group[:, None] + np.arange(_GROUP)
        columns_of_view = np.concatenate([own, shared], 1)
        B = _rows(structure, 3 * kept.point[:, None] + np.arange(3), 3 * len(points))
        self.camera, self.camera_right = np.zeros((columns, columns)), np.zeros(columns)
        for view in np.arange(len(rig.group)):
            rows = np.flatnonzero(views == view)
            jacobian = cameras[rows].reshape(2 * len(rows), _OWN + _GROUP)
            of_view = columns_of_view[view]
            self.camera[np.ix_(of_view, of_view)] += jacobian.T @ jacobian
            self.camera_right[of_view] += jacobian.T @ residual[rows].ravel()
        A = _rows(cameras, columns_of_view[views], columns)
        self._mixed = (A.T @ B).tocsr()
        right = residual.ravel()
        self._blocks = np.zeros((len(points), 3, 3))
        np.add.at(self._blocks, kept.point, np.einsum("mki,mkj->mij", structure, structure))
        self._point_right = (B.T @ right).reshape(-1, 3)
        self._add_priors()
        free = np.ones(columns, bool)
        unseen = np.setdiff1d(np.arange(len(rig.group)), views)
        free[(_OWN * unseen[:, None] + np.arange(_POSE)).ravel()] = False
        if priors.deviation_sigma == 0:
            free[_POSE : _OWN * len(rig.group) : _OWN] = False
        first = _OWN * len(rig.group)
        free[first::_GROUP] = (priors.focal_sigma > 0) & np.isin(np.arange(len(rig.focals_px)), rig.group)
        free[first + 1 :: _GROUP] = np.asarray(priors.k1_sigma) > 0
        self.free = np.flatnonzero(free)

    def _jacobians(self, kept: Observations, weight: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Derivatives of weighted residuals: (M, 2, 9) by the camera's columns, (M, 2, 3) by the point."""
        rig = self._rig
        R = rig.rotations[kept.view]
        local = np.einsum("mij,mj->mi", R, self._points[kept.point]) + rig.translations[kept.view]
        depth = local[:, 2]
        ray = local[:, :2] / depth[:, None]
        radius = (ray**2).sum(1)
        k1 = rig.k1[rig.group[kept.view]]
        focal = rig.view_focals_px[kept.view]
        stretch = 1 + k1 * radius
        # d (stretch * ray) / d ray, then d ray / d local.
        by_ray = stretch[:, None, None] * np.eye(2) + 2 * k1[:, None, None] * ray[:, :, None] * ray[:, None, :]
        by_local = np.zeros((len(local), 2, 3))
        by_local[:, 0, 0] = by_local[:, 1, 1] = 1 / depth
        by_local[:, :, 2] = -ray / depth[:, None]
        by_local = (focal * weight)[:, None, None] * (by_ray @ by_local)
        cameras = np.empty((len(local), 2, _OWN + _GROUP))
        # exp(w) p = p + w x p: the derivative is -[p]x, whose rows are the cross products of p with the rows.
        cameras[:, :, :3] = np.cross(local[:, None, :], by_local)
        cameras[:, :, 3:6] = by_local
        by_log_focal = (focal * weight * stretch)[:, None] * ray
        cameras[:, :, 6] = cameras[:, :, 7] = by_log_focal
        cameras[:, :, 8] = (focal * weight * radius)[:, None] * ray
        return cameras, by_local @ R

    def _add_priors(self) -> None:
        rig, priors, views = self._rig, self._priors, len(self._rig.group)
        by_point, by_focal, by_k1, by_deviation = _prior_residuals(rig, self._points, priors)
        information = _inverse(priors.point_sigma_m)
        self._blocks += information[:, None, None] ** 2 * np.eye(3)
        self._point_right += information[:, None] * by_point
        focal = _OWN * views + _GROUP * np.arange(len(rig.focals_px))
        own = _OWN * np.arange(views) + _POSE
        for columns, sigma, residual in (
            (focal, priors.focal_sigma, by_focal),
            (focal + 1, np.asarray(priors.k1_sigma, np.float64), by_k1),
            (own, np.array(priors.deviation_sigma), by_deviation),
        ):
            self.camera[columns, columns] += _inverse(sigma) ** 2
            self.camera_right[columns] += _inverse(sigma) * residual

    def reduced(self, damping: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The system of the free camera columns, and the inverted blocks of the points."""
        blocks = self._blocks.copy()
        diagonal = np.einsum("pii->pi", blocks)
        # A point without two rays has a direction without information: the floor leaves it where it is.
        diagonal[:] = diagonal * (1 + damping) + 1e-9 * diagonal.sum(1, keepdims=True) + 1e-9
        inverse = np.linalg.inv(blocks)
        camera = self.camera.copy()
        camera[np.diag_indices_from(camera)] *= 1 + damping
        matrix, right = camera[np.ix_(self.free, self.free)], self.camera_right[self.free].copy()
        mixed = self._mixed[self.free].tocsc()
        for first in range(0, len(blocks), _CHUNK):  # dense products are faster, but whole ones would fill the memory
            part = inverse[first : first + _CHUNK]
            dense = mixed[:, 3 * first : 3 * (first + len(part))].T.toarray()  # its rows are the points'
            carried = (part @ dense.reshape(len(part), 3, -1)).reshape(dense.shape)
            matrix -= carried.T @ dense
            right -= carried.T @ self._point_right[first : first + _CHUNK].ravel()
        return matrix, right, inverse

    def step(self, damping: float) -> tuple[Rig, np.ndarray]:
        """The state after one damped step."""
        matrix, right, inverse = self.reduced(damping)
        full = np.zeros(len(self.camera))
        full[self.free] = -_solved(matrix, right)
        point_right = self._point_right + (self._mixed.T @ full).reshape(-1, 3)
        points = self._points - np.einsum("pij,pj->pi", inverse, point_right)
        rig, views = self._rig, len(self._rig.group)
        own, shared = full[: _OWN * views].reshape(views, _OWN), full[_OWN * views :].reshape(-1, _GROUP)
        turn = Rotation.from_rotvec(own[:, :3]).as_matrix()
        moved = replace(
            rig,
            rotations=turn @ rig.rotations,
            translations=np.einsum("nij,nj->ni", turn, rig.translations) + own[:, 3:6],
            deviation=np.clip(rig.deviation + own[:, 6], -1.0, 1.0),
            focals_px=rig.focals_px * np.exp(np.clip(shared[:, 0], -0.5, 0.5)),
            k1=rig.k1 + shared[:, 1],
        )
        return moved, points


def _rows(values: np.ndarray, columns: np.ndarray, width: int) -> sparse.csr_array:
    """A sparse matrix of two rows per observation; `values` (M, 2, C), `columns` (M, C)."""
    count, _, per_row = values.shape
    starts = per_row * np.arange(2 * count + 1)
    index = np.repeat(columns, 2, axis=0).ravel()
    return sparse.csr_array((values.ravel(), index, starts), shape=(2 * count, width))


def _solved(matrix: np.ndarray, right: np.ndarray) -> np.ndarray:
    """The solution of a symmetric system; scaled to a unit diagonal, as radians and metres differ by magnitudes."""
    scale = 1 / np.sqrt(np.maximum(np.diag(matrix), 1e-30))
    scaled = matrix * scale[:, None] * scale
    try:
        return scale * np.linalg.solve(scaled, scale * right)
    except np.linalg.LinAlgError:
        return scale * (np.linalg.pinv(scaled, hermitian=True) @ (scale * right))


def _result(
    rig: Rig, points: np.ndarray, observations: Observations, priors: Priors, iterations: int, converged: bool
) -> Adjusted:
    residual, squared = _residuals(rig, points, observations)
    weights = _weights(squared)
    system = _System(rig, points, observations, priors)
    matrix = system.reduced(0.0)[0]
    scale = 1 / np.sqrt(np.maximum(np.diag(matrix), 1e-30))
    # The gauge has eigenvalues near 0; focal lengths and distortion do not depend on it.
    covariance = np.linalg.pinv(matrix * scale[:, None] * scale, rcond=1e-9, hermitian=True) * scale[:, None] * scale
    full = np.zeros_like(system.camera)
    full[np.ix_(system.free, system.free)] = covariance
    freedom = max(2 * weights.sum() - len(system.free) - 3 * len(np.unique(observations.point)), 1.0)
    inliers = np.isfinite(squared)
    variance = float((weights * np.where(inliers, squared, 0.0)).sum() / freedom)
    views = len(rig.group)
    focal = _OWN * views + _GROUP * np.arange(len(rig.focals_px))
    own, of_group = _OWN * np.arange(views) + _POSE, focal[rig.group]
    by_view = full[own, own] + full[of_group, of_group] + 2 * full[own, of_group]
    root = np.sqrt(variance)
    return Adjusted(
        rig=rig,
        points=points,
        residuals_px=residual,
        weights=weights,
        unit_variance=variance,
        focal_sigma_px=rig.focals_px * np.sqrt(np.maximum(full[focal, focal], 0)) * root,
        view_focal_sigma_px=rig.view_focals_px * np.sqrt(np.maximum(by_view, 0)) * root,
        k1_sigma=np.sqrt(np.maximum(full[focal + 1, focal + 1], 0)) * root,
        iterations=iterations,
        converged=converged,
    )
