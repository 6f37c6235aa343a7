"""The energy of a landmark fit in maximum-a-posteriori units, and its normal equations (Wood 2022).

E = sum rho(r^2 / sigma^2) / 2 + |b|^2 / 2 + sum_f |f|^2 / 2 + the priors of joints and cameras + temporal and
anatomical terms; r are reprojection errors of landmarks.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int

from registration.landmark_fit.anatomy import Anatomy
from registration.landmark_fit.landmark_model import LandmarkModel, differences
from registration.landmark_fit.linear_system import ArrowSystem, Coordinates
from registration.landmark_fit.options import FitOptions
from registration.landmark_fit.state import Free, Layout, State
from registration.landmark_fit.views import NEAR_M, ViewState, ViewTerms, view_terms

_POSE_SCALE = 100.0  # damping of poses, which have no prior: that of a standard deviation of 0.1 rad or m
_BLOCK = 512  # landmarks whose derivatives are computed at once: they stay in the processor's cache
_BEHIND = 1e8  # squared standard deviations of a landmark behind a camera


@dataclass(frozen=True, kw_only=True, eq=False)
class Problem:
    """One subject's fit: model, observations and priors; constant during a stage."""

    model: LandmarkModel
    anatomy: Anatomy | None
    layout: Layout
    options: FitOptions
    group: Int[np.ndarray, "N"]  # of the views' focal lengths
    points_px: Float[np.ndarray, "F N L 2"]  # NaN: not seen, or not used in this stage
    sigma_px: Float[np.ndarray, "F N L"]
    robust: bool
    pivot: Float[np.ndarray, "3"]
    log_focal_mean: Float[np.ndarray, "G"]
    centre_px: Float[np.ndarray, "N 2"]
    first_view: int  # whose camera's frame is the world, if no pose is given
    principal_sigma_px: float
    expression_change: Float[np.ndarray, "Q Q"] | None  # information of the temporal prior on coefficients
    reuse: bool = False  # second derivatives in several iterations, as landmarks are many
    spread_m: Float[np.ndarray, "L"] | None = None  # of the model's landmarks; part of a stage's `sigma_px`

    # ---- values

    def energy(self, state: State, limit: float = np.inf) -> float:
        """The energy at a state; infinity if landmarks and priors alone exceed the limit."""
        total = self._prior_energy(state)
        for f in range(len(state.expression)):
            posed = self.model(state.identity, state.expression[f], state.joints[f])
            world = self._world(state, f, posed.points)
            for v in range(len(self.group)):
                rows = np.flatnonzero(np.isfinite(self.points_px[f, v, :, 0]))
                if not len(rows):
                    continue
                squared = self.squared(state, f, v, world, rows)
                total += 0.5 * float(self._rho(squared).sum())
            if total > limit:
                return np.inf
        for f in range(len(state.expression) if self.anatomy is not None else 0):
            assert self.anatomy is not None
            total += self.anatomy.energy(state.identity, state.expression[f], state.joints[f])
            if total > limit:
                return np.inf
        return total

    def squared(self, state: State, f: int, v: int, world: np.ndarray, rows: np.ndarray) -> Float[np.ndarray, "M"]:
        """Squared reprojection errors over variances."""
        pixels, depth = self.project(state, v, world[rows])
        squared = (((pixels - self.points_px[f, v, rows]) / self.sigma_px[f, v, rows, None]) ** 2).sum(1)
        return np.where(depth > NEAR_M, np.minimum(np.nan_to_num(squared, nan=_BEHIND), _BEHIND), _BEHIND)

    def project(self, state: State, v: int, world: Float[np.ndarray, "M 3"]) -> tuple[np.ndarray, np.ndarray]:
        """Pixels and depths of world points in a view."""
        local = world @ state.view_rotations[v].T + state.view_translations[v]
        depth = local[:, 2]
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            ray = local[:, :2] / depth[:, None]
            stretch = 1 + state.k1[self.group[v]] * (ray**2).sum(1)
            return np.exp(state.log_focal[self.group[v]]) * stretch[:, None] * ray + state.principal_px[v], depth

    def _world(self, state: State, f: int, points: Float[np.ndarray, "L 3"]) -> Float[np.ndarray, "L 3"]:
        return np.exp(state.log_size) * (points - self.pivot) @ state.joints[f, 0].T + state.position[f]

    def world(self, state: State, f: int) -> Float[np.ndarray, "L 3"]:
        """The landmarks of a frame in the world, metres."""
        return self._world(state, f, self.model(state.identity, state.expression[f], state.joints[f]).points)

    def weights(self, squared: Float[np.ndarray, "M"]) -> Float[np.ndarray, "M"]:
        """Robust weights: those of Geman and McClure; all one before the robust stage."""
        return 1 / (1 + squared / self.options.robust_sigmas**2) ** 2 if self.robust else np.ones_like(squared)

    def _rho(self, squared: np.ndarray) -> np.ndarray:
        return squared / (1 + squared / self.options.robust_sigmas**2) if self.robust else squared

    # ---- priors

    def _joint_sigmas(self) -> Float[np.ndarray, "C"]:
        first = [self.options.head_rotation] * 3
        return np.array(first + [self.options.eye_rotation] * (3 * (self.layout.joints - 2)))[
            : 3 * (self.layout.joints - 1)
        ]

    def _prior_residuals(self, state: State) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Weighted residuals and information (their derivatives' square): of frames (F, n), of the shared (m)."""
        layout, options = self.layout, self.options
        frames = len(state.expression)
        local, local_info = np.zeros((frames, layout.local_count)), np.zeros(layout.local_count)
        local[:, layout.local("expression")] = state.expression
        local_info[layout.local("expression")] = 1
        turns = differences(state.joints[:, 1:], np.broadcast_to(np.eye(3), state.joints[:, 1:].shape))
        joint_info = 1 / self._joint_sigmas() ** 2
        local[:, layout.local("joints")] = turns.reshape(frames, -1) * joint_info
        local_info[layout.local("joints")] = joint_info
        shared, info = np.zeros(layout.shared_count), np.zeros(layout.shared_count)
        for name, value, sigma in (
            ("identity", state.identity, 1.0),
            ("size", state.log_size - np.log(options.scale), options.log_size),
            ("focal", state.log_focal - self.log_focal_mean, options.log_focal),
            ("principal", (state.principal_px - self.centre_px).ravel(), self.principal_sigma_px),
            ("k1", state.k1, options.distortion_sigma),
        ):
            shared[layout.shared(name)] = value / sigma**2
            info[layout.shared(name)] = 1 / sigma**2
        return local, local_info, shared, info

    def _prior_energy(self, state: State) -> float:
        local, local_info, shared, info = self._prior_residuals(state)
        total = _half_squares(local, local_info) + _half_squares(shared, info)
        if self.options.temporal is not None and len(state.expression) > 1:
            change = self._changes(state)
            total += 0.5 * float(np.einsum("fi,ij,fj->", change, self._change_information(), change))
        return total

    def _changes(self, state: State) -> Float[np.ndarray, "_ n"]:
        layout = self.layout
        change = np.zeros((len(state.expression) - 1, layout.local_count))
        change[:, layout.local("expression")] = np.diff(state.expression, axis=0)
        turns = differences(state.joints[1:], state.joints[:-1])
        change[:, layout.local("root")] = turns[:, 0]
        change[:, layout.local("joints")] = turns[:, 1:].reshape(len(change), -1)
        change[:, layout.local("position")] = np.diff(state.position, axis=0)
        return change

    def _change_information(self) -> Float[np.ndarray, "n n"]:
        layout, temporal = self.layout, self.options.temporal
        assert temporal is not None and self.expression_change is not None
        information = np.zeros((layout.local_count, layout.local_count))
        own = layout.local("expression")
        information[own, own] = self.expression_change
        for name, sigma in (
            ("joints", temporal.rotation),
            ("root", temporal.rotation),
            ("position", temporal.translation_m),
        ):
            index = np.arange(layout.local_count)[layout.local(name)]
            information[index, index] = 1 / sigma**2
        return information

    # ---- normal equations

    def system(self, state: State, free: Free) -> ArrowSystem:
        """The Gauss-Newton normal equations in the free columns, with robust weights (iteratively reweighted)."""
        frames, n, m = len(state.expression), len(free.local), len(free.shared)
        local, mixed = np.zeros((frames, n, n)), np.zeros((frames, n, m))
        shared, gradient, shared_gradient = np.zeros((m, m)), np.zeros((frames, n)), np.zeros(m)
        for f in range(frames):
            for jacobian, residual in [*self._frame_rows(state, f, free), *self._anatomy_rows(state, f, free)]:
                product = jacobian.T @ jacobian
                local[f] += product[:n, :n]
                mixed[f] += product[:n, n:]
                shared += product[n:, n:]
                pull = jacobian.T @ residual
                gradient[f] += pull[:n]
                shared_gradient += pull[n:]
        _, prior_info, _, shared_info = self._prior_residuals(state)
        diagonal = np.arange(n)
        local[:, diagonal, diagonal] += prior_info[free.local]
        shared[np.arange(m), np.arange(m)] += shared_info[free.shared]
        local_prior, shared_prior = self._prior_gradient(state, free)
        neighbours = None
        if self.options.temporal is not None and frames > 1:
            information = self._change_information()[np.ix_(free.local, free.local)]
            local[1:] += information
            local[:-1] += information
            neighbours = -information
        return ArrowSystem(
            local=local,
            neighbours=neighbours,
            mixed=mixed,
            shared=shared,
            local_gradient=gradient + local_prior,
            shared_gradient=shared_gradient + shared_prior,
            local_scale=np.where(prior_info > 0, prior_info, _POSE_SCALE)[free.local],
            shared_scale=np.where(shared_info > 0, shared_info, _POSE_SCALE)[free.shared],
        )

    def with_gradient(self, system: ArrowSystem, state: State, free: Free) -> ArrowSystem:
        """The system of another state with the gradient of this one."""
        gradient, shared_gradient = self._prior_gradient(state, free)
        for f in range(len(state.expression)):
            local_pull, shared_pull = self._data_gradient(state, f)
            gradient[f] += local_pull[free.local]
            shared_gradient += shared_pull[free.shared]
            for jacobian, residual in self._anatomy_rows(state, f, free):
                pull = jacobian.T @ residual
                gradient[f] += pull[: len(free.local)]
                shared_gradient += pull[len(free.local) :]
        return replace(system, local_gradient=gradient, shared_gradient=shared_gradient)

    def _prior_gradient(self, state: State, free: Free) -> tuple[np.ndarray, np.ndarray]:
        local, _, shared, _ = self._prior_residuals(state)
        gradient = local[:, free.local]
        if self.options.temporal is not None and len(gradient) > 1:
            pull = (self._changes(state) @ self._change_information())[:, free.local]
            gradient[1:] += pull
            gradient[:-1] -= pull
        return gradient, shared[free.shared]

    def coordinates(self, state: State, free: Free) -> Coordinates:
        """Unknowns in which a focal length changes the distance too, so that the head keeps its size in the image."""
        layout = self.layout
        n, m = len(free.local), len(free.shared)
        along, within = np.zeros((len(state.position), n, m)), np.zeros((m, m))
        position = np.searchsorted(free.local, np.arange(layout.local_count)[layout.local("position")])
        for v, group in enumerate(self.group):
            column = layout.shared("focal").start + int(group)
            at = int(np.searchsorted(free.shared, column))
            if at == m or free.shared[at] != column:
                continue
            depth = state.position @ state.view_rotations[v, 2] + state.view_translations[v, 2]
            if v == self.first_view:
                along[:, position, at] = depth[:, None] * state.view_rotations[v, 2]
            else:
                poses = layout.shared("poses").start + 6 * v + np.arange(3, 6)
                rows = np.searchsorted(free.shared, poses)
                if rows[-1] < m and (free.shared[rows] == poses).all():
                    own = along[:, position, at].mean(0)
                    within[rows, at] = np.array([0, 0, depth.mean()]) - state.view_rotations[v] @ own
        return Coordinates(along=along, within=within)

    def _frame_rows(self, state: State, f: int, free: Free) -> Sequence[tuple[np.ndarray, np.ndarray]]:
        """Weighted Jacobian (rows, n + m) and residuals of each view of a frame."""
        layout = self.layout
        wants = _wanted(layout, free)
        seen = np.isfinite(self.points_px[f, :, :, 0])
        in_frame = np.flatnonzero(seen.any(0))
        result = []
        for rows in np.split(in_frame, range(_BLOCK, len(in_frame), _BLOCK)) if len(in_frame) else ():
            posed = self.model(
                state.identity,
                state.expression[f],
                state.joints[f],
                rows=rows,
                by_identity="identity" in wants,
                by_expression="expression" in wants,
                by_joints="joints" in wants or self.model.has_correctives,
            )
            world = self._world(state, f, posed.points)
            columns = self._world_columns(state, f, posed, world, free)
            for v in np.flatnonzero(seen[:, rows].any(1)):
                result.append(self._view_rows(state, f, int(v), world, columns, rows, free))
        return result

    def _anatomy_rows(self, state: State, f: int, free: Free) -> Sequence[tuple[np.ndarray, np.ndarray]]:
        if self.anatomy is None:
            return []
        return self.anatomy.rows(state.identity, state.expression[f], state.joints[f], self.layout, free)

    def _world_columns(self, state, f, posed, world, free) -> Float[np.ndarray, "3 M _"]:  # type: ignore[no-untyped-def]
        """Derivatives of the world's points by the free columns; those of cameras are zero."""
        layout = self.layout
        size_root = np.exp(state.log_size) * state.joints[f, 0]
        arm = world - state.position[f]
        count = len(world)
        local, shared = {}, {}
        if posed.by_expression is not None:
            local["expression"] = _rotated(size_root, posed.by_expression)
        root = -_cross_matrices(arm)
        if posed.by_joints is not None:
            turns = _rotated(size_root, posed.by_joints)
            local["joints"] = turns[:, :, 3:]
            root = root + turns[:, :, :3]
        local["root"] = root
        local["position"] = np.broadcast_to(np.eye(3)[:, None], (3, count, 3))
        if posed.by_identity is not None:
            shared["identity"] = _rotated(size_root, posed.by_identity)
        shared["size"] = arm.T[..., None]
        columns = np.zeros((3, count, len(free.local) + len(free.shared)))
        for names, blocks, chosen, start in (
            (layout.local_names, local, free.local, 0),
            (layout.shared_names, shared, free.shared, len(free.local)),
        ):
            first = 0
            for name, width in names:
                low, high = np.searchsorted(chosen, [first, first + width])
                if high > low and name in blocks:
                    block = blocks[name]
                    whole = high - low == width
                    columns[:, :, start + low : start + high] = (
                        block if whole else block[:, :, chosen[low:high] - first]
                    )
                first += width
        return columns

    def _view_rows(
        self, state: State, f: int, v: int, world: np.ndarray, columns: np.ndarray, rows: np.ndarray, free: Free
    ) -> tuple[np.ndarray, np.ndarray]:
        """Weighted Jacobian and residuals of the landmarks that one view shows; `columns` are of all of `world`."""
        of_view = np.flatnonzero(np.isfinite(self.points_px[f, v, rows, 0]))
        view = self._view(state, f, v, world[of_view], rows[of_view])
        part = columns if len(of_view) == columns.shape[1] else columns[:, of_view]
        jacobian = np.empty((len(of_view), 2, columns.shape[2]))
        for axis in range(2):
            np.multiply(part[0], view.by_world[:, axis, 0, None], out=jacobian[:, axis])
            jacobian[:, axis] += part[1] * view.by_world[:, axis, 1, None]
            jacobian[:, axis] += part[2] * view.by_world[:, axis, 2, None]
        for first, value in view.by_camera(self.layout, v, int(self.group[v])):
            at, kept = _within(free.shared, first, value.shape[2])
            jacobian[:, :, len(free.local) + at] += value[:, :, kept]
        return jacobian.reshape(-1, jacobian.shape[2]), view.residual.ravel()

    def _view(self, state: State, f: int, v: int, world: np.ndarray, rows: np.ndarray) -> ViewTerms:
        camera = ViewState(
            rotation=state.view_rotations[v],
            translation=state.view_translations[v],
            focal_px=float(np.exp(state.log_focal[self.group[v]])),
            k1=float(state.k1[self.group[v]]),
            principal_px=state.principal_px[v],
        )
        return view_terms(world, self.points_px[f, v, rows], self.sigma_px[f, v, rows], camera, self.weights)

    def _data_gradient(self, state: State, f: int) -> tuple[np.ndarray, np.ndarray]:
        """Gradient of a frame's landmark term by all columns, without the matrix of derivatives."""
        layout = self.layout
        local, shared = np.zeros(layout.local_count), np.zeros(layout.shared_count)
        world = self.world(state, f)
        forces = np.zeros_like(world)
        for v in range(len(self.group)):
            rows = np.flatnonzero(np.isfinite(self.points_px[f, v, :, 0]))
            if not len(rows):
                continue
            view = self._view(state, f, v, world[rows], rows)
            forces[rows] += np.einsum("maw,ma->mw", view.by_world, view.residual)
            for first, value in view.by_camera(layout, v, int(self.group[v])):
                shared[first : first + value.shape[2]] += np.einsum("mak,ma->k", value, view.residual)
        arm, size, root = world - state.position[f], np.exp(state.log_size), state.joints[f, 0]
        identity, expression, joints = self.model.pulled_back(
            state.identity, state.expression[f], state.joints[f], size * forces @ root
        )
        local[layout.local("expression")] = expression
        local[layout.local("joints")] = joints[3:]
        local[layout.local("root")] = np.cross(arm, forces).sum(0) + joints[:3]
        local[layout.local("position")] = forces.sum(0)
        shared[layout.shared("identity")] += identity
        shared[layout.shared("size")] += (arm * forces).sum()
        return local, shared


def _within(chosen: np.ndarray, first: int, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Where columns first, first + 1, ... are among the chosen ones, and which of them are."""
    at = np.flatnonzero((chosen >= first) & (chosen < first + count))
    return at, chosen[at] - first


def _wanted(layout: Layout, free: Free) -> set[str]:
    names = set()
    for blocks, chosen in ((layout.local_names, free.local), (layout.shared_names, free.shared)):
        first = 0
        for name, width in blocks:
            low, high = np.searchsorted(chosen, [first, first + width])
            if high > low:
                names.add(name)
            first += width
    return names


def _rotated(matrix: np.ndarray, columns: np.ndarray) -> np.ndarray:
    return (matrix @ columns.reshape(3, -1)).reshape(columns.shape)


def _cross_matrices(vectors: Float[np.ndarray, "M 3"]) -> Float[np.ndarray, "3 M 3"]:
    """[v]x of each vector, rows first."""
    x, y, z = vectors.T
    zero = np.zeros_like(x)
    return np.stack([np.stack([zero, -z, y], 1), np.stack([z, zero, -x], 1), np.stack([-y, x, zero], 1)])


def _half_squares(weighted: np.ndarray, information: np.ndarray) -> float:
    """|r|^2 / 2 from information-weighted residuals."""
    with np.errstate(divide="ignore", invalid="ignore"):
        return 0.5 * float(np.where(information > 0, weighted**2 / information, 0).sum())
