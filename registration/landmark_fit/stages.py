"""The stages of a landmark fit: pose and focal length; identity; everything; everything, robust (Wood 2022)."""

from dataclasses import replace

import numpy as np
from jaxtyping import Float

from registration.landmark_fit.anatomy import Anatomy
from registration.landmark_fit.energy import Problem
from registration.landmark_fit.landmark_model import LandmarkModel
from registration.landmark_fit.observations import Observations
from registration.landmark_fit.options import FitOptions
from registration.landmark_fit.reduction import Reduction
from registration.landmark_fit.solver import Minimum, minimize
from registration.landmark_fit.start import Start
from registration.landmark_fit.state import Free, Layout, State, free_columns

_MANY, _COARSE = 1500, 400  # landmarks above which stages before the last use so many of them
_COARSE_ITERATIONS = 12
_SOFT = 2.0  # factor of the anatomical term's standard deviations before the last stage
_COARSE_TOLERANCE = 0.3


def run_stages(
    observations: Observations,
    options: FitOptions,
    start: Start,
    state: State,
    model: LandmarkModel,
    reduction: Reduction,
    anatomy: Anatomy | None,
) -> tuple[Minimum, Problem, Free]:
    """Minimize the energy from a start.

    Args:
        observations: of one subject.
        options: of the fit.
        start: what is known of the cameras.
        state: where to begin.
        model: the landmarks' functions.
        reduction: of the expression coefficients.
        anatomy: the anatomical term; None: there is none.

    Returns:
        The end of the last stage, its energy, and its free columns.
    """
    layout = Layout(
        identity=len(state.identity),
        groups=len(start.log_focal),
        views=len(observations.views),
        expression=reduction.basis.shape[1],
        joints=model.joint_count,
    )
    temporal = options.temporal
    problem = Problem(
        model=model,
        anatomy=None,
        layout=layout,
        options=options,
        group=start.group,
        points_px=observations.points_px,
        sigma_px=observations.sigma_px,
        spread_m=observations.scheme.spread_m,
        robust=False,
        pivot=start.pivot,
        log_focal_mean=start.log_focal,
        centre_px=start.centre_px,
        first_view=start.first_view,
        principal_sigma_px=options.principal_sigma * max(view.width_px for view in observations.views),
        expression_change=None if temporal is None else reduction.basis.T @ reduction.basis / temporal.expression**2,
    )
    iterations, frames = 0, len(observations.points_px)
    names = ["root", "position", "poses"]
    many = problem.points_px.shape[2] > _MANY
    shape = ["focal"] if options.identity is not None else ["focal", "identity"]
    rest = ["expression", "joints", *(["size"] if options.size else [])]
    rest += ["principal"] if options.principal_point else []
    rest += ["k1"] if options.distortion else []
    for added in ([], shape, rest):
        names = names + added
        free = _free(layout, start, names)
        weighted = _weighted(problem, state)
        coarse = _thinned(weighted) if many else weighted
        # The robust stage must not begin with parts in one another: it would give up landmarks for them.
        soft = anatomy.softened(_SOFT) if anatomy is not None and added is rest else None
        minimum = minimize(replace(coarse, anatomy=soft), state, free, _COARSE_ITERATIONS, _COARSE_TOLERANCE * frames)
        state, iterations = minimum.state, iterations + minimum.iterations
    last = replace(_weighted(problem, state), anatomy=anatomy, robust=options.robust, reuse=many)
    minimum = minimize(last, state, free, options.max_iterations, options.tolerance * frames)
    return replace(minimum, iterations=iterations + minimum.iterations), last, free


def _free(layout: Layout, start: Start, names: list[str]) -> Free:
    local, shared = np.zeros(layout.local_count, bool), np.zeros(layout.shared_count, bool)
    for name, _ in layout.local_names:
        local[layout.local(name)] = name in names
    for name, _ in layout.shared_names:
        shared[layout.shared(name)] = name in names
    known = np.array(start.group_known)
    shared[layout.shared("focal")] &= ~known
    uncalibrated = ~np.array(start.centre_known)
    shared[layout.shared("k1")] &= np.isin(np.arange(layout.groups), start.group[uncalibrated])
    shared[layout.shared("principal")] &= np.repeat(uncalibrated, 2)
    shared[layout.shared("poses")] &= ~np.repeat(np.array(start.pose_known), 6)
    return free_columns(layout, local, shared)


def _thinned(problem: Problem) -> Problem:
    """With a part of the landmarks; their information stays about the same."""
    count = problem.points_px.shape[2]
    rows = np.unique(np.linspace(0, count - 1, _COARSE).round().astype(int))
    return replace(
        problem,
        model=problem.model.subset(rows),
        points_px=problem.points_px[:, :, rows],
        sigma_px=problem.sigma_px[:, :, rows] * np.sqrt(len(rows) / count),
        anatomy=None,
    )


def _weighted(problem: Problem, state: State) -> Problem:
    """With standard deviations that contain the spread of the model's landmarks, in pixels at their depth.

    A landmark that is elsewhere on the model is so in all views: together they count as one.
    """
    sigma = problem.sigma_px**2
    spread = problem.spread_m
    if spread is not None:
        spread = spread * np.sqrt(np.maximum(np.isfinite(problem.points_px[..., 0]).sum(1), 1))  # F L
        for f in range(len(sigma)):
            world = problem.world(state, f)
            for v in range(sigma.shape[1]):
                depth = world @ state.view_rotations[v, 2] + state.view_translations[v, 2]
                scale: Float[np.ndarray, L] = np.exp(state.log_focal[problem.group[v]]) / np.maximum(depth, 0.05)
                sigma[f, v] += (spread[f] * scale * np.exp(state.log_size)) ** 2
    return replace(problem, sigma_px=np.sqrt(sigma * problem.options.correlated))
