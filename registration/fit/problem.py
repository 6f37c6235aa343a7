"""The fitting problem of one capture from one initial guess: its stages, and measurements of its current state."""

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from registration.fit.appearance import Appearance
from registration.fit.camera_refinement import CameraRefinement
from registration.fit.context import FitContext
from registration.fit.initialization import PoseCandidate, rate_candidate
from registration.fit.landmark_slide import slide_to_landmarks
from registration.fit.optimizer import AdamBlock, AdamUniformBlock, History, ParameterBlock, minimize
from registration.fit.recipes import Lengths, Stage, rigid_stage
from registration.fit.terms import StageContext, StepState, Term, make_terms
from registration.fit.unfolding import unfold
from registration.fit.variables import InitialGuess, Variables
from registration.fit.view_weights import HEAD_PX, MIN_ERROR_PX, ViewErrors, ViewWeights, view_errors
from registration.frames import MM_PER_M
from registration.geometry.large_steps import LargeSteps
from registration.losses import image, landmark
from registration.losses.regularization import OffsetRegularizer
from registration.types import Rendered, Targets

_MOTION_FRACTION = 0.1  # of the last stage's steps, over which the motion of the vertices is measured
_MAX_STEP_MM = 2.0  # of a region with a rate scale of its own, unless the stage itself steps further
_TEXTURE_STEPS = 2  # after which the texture is updated: it follows the mean of many, and is a tenth of a step's cost
_AGREEING_VIEWS = 3  # that locate a landmark; of two, a wrong one moves the point along the other's ray


OnStep = Callable[[Stage, int], None]


@dataclass(frozen=True, kw_only=True)
class FitTrace:
    """How the stages went."""

    history: Mapping[str, History] = field(default_factory=dict)  # stage -> term -> value per step
    seconds: Mapping[str, float] = field(default_factory=dict)  # stage -> duration
    motion_mm: float = float("inf")  # 95th percentile of vertex motion over the last steps of the last stage
    failure: str | None = None  # why it stopped early


@dataclass(frozen=True, kw_only=True)
class _StageTrace:
    history: History
    motion_mm: float | None  # None: it stopped before the motion could be measured
    failure: str | None


class FitProblem:
    """Variables, texture and view weights of one fit. What does not depend on the initial guess is in `context`.

    Args:
        context: model, targets and recipe.
        initial: where the variables start.
    """

    def __init__(self, context: FitContext, initial: InitialGuess):
        self.context = context
        self.variables = Variables(context.model, context.data, initial)
        self.appearance = Appearance(context.renderer, context.texture_px, context.view_count, context.device)
        if context.neutral is not None:
            self.appearance.set_texture(context.neutral.texture)
        self.view_weights = ViewWeights.uniform(context.view_count)
        self.landmarks_used: dict[str, Bool[np.ndarray, L]] = {
            name: initial.landmarks_used.get(name, np.ones(len(scheme.indices), bool))
            for name, scheme in context.captured_schemes.items()
        }
        self.refinement = None if context.camera_sigma_px is None else CameraRefinement(context, self.vertices())

    @property
    def pyramid(self) -> tuple[Targets, ...]:
        """The targets, with the cameras as they are corrected."""
        return self.context.pyramid if self.refinement is None else self.refinement.pyramid

    def vertices(self) -> Float[Tensor, "V 3"]:
        """Return the mesh as it is: world, metres, without gradients."""
        with torch.no_grad():
            return self.variables.vertices(self.variables.skin_offsets())

    def run(self, stages: Sequence[Stage], on_step: OnStep = lambda stage, step: None) -> FitTrace:
        """Run stages until one fails. View weights are estimated before the first and after each stage.

        Args:
            stages: in order, of the recipe.
            on_step: called after every step with its stage and number from 0.

        Returns:
            History, durations and failure; stages after a failed one are missing.
        """
        history: dict[str, History] = {}
        seconds: dict[str, float] = {}
        motion_mm, failure = float("inf"), None
        self.view_weights = ViewWeights.from_errors(self.view_errors())
        if self.refinement is not None:
            self.refinement.start(self.view_weights, self.landmarks_used)
        for stage in stages:
            start_time = time.perf_counter()
            trace = self._run_stage(stage, on_step)
            history[stage.name], seconds[stage.name] = trace.history, time.perf_counter() - start_time
            motion_mm = motion_mm if trace.motion_mm is None else trace.motion_mm
            if trace.failure:
                failure = f"stage {stage.name}: {trace.failure}"
                break
            self.view_weights = ViewWeights.from_errors(self.view_errors())
        return FitTrace(history=history, seconds=seconds, motion_mm=motion_mm, failure=failure)

    def _run_stage(self, stage: Stage, on_step: OnStep) -> _StageTrace:
        recipe = self.context.recipe
        if stage.landmark_slide:
            slide_to_landmarks(self.context, self.variables, self.landmarks_used)
        fixed = {name for name, free in (("scale", recipe.scale), ("parts", self.variables.has_parts)) if not free}
        names = [name for name, _ in stage.free if name not in fixed]
        lengths = stage.lengths if "offsets" in names else None
        regularizer, steps = (None, None) if lengths is None else self._prepare_regularizer(lengths)
        self.variables.set_free(names, steps)
        if stage.texture and not self.appearance.has_texture:
            self.appearance.unwrap_views(self.vertices(), self._all_views(stage))
        terms = make_terms(
            StageContext(
                fit=self.context,
                stage=stage,
                variables=self.variables,
                appearance=self.appearance,
                landmarks_used=self.landmarks_used,
                regularizer=regularizer,
            )
        )
        measure_from = stage.steps - max(1, int(_MOTION_FRACTION * stage.steps))
        before: list[Tensor] = []

        def after_step(step: int) -> None:
            if step == max(0, measure_from - 1):
                before.append(self.vertices())
            on_step(stage, step)

        history, failure = minimize(
            self._parameter_blocks(stage, names), lambda step: self._losses(stage, terms, step), stage.steps, after_step
        )
        motion = [(self.vertices() - vertices).norm(dim=-1) * MM_PER_M for vertices in before]
        self.variables.commit_latent()
        if stage.weights.folds > 0 and "offsets" in names:
            unfold(self.context, self.variables)
        return _StageTrace(
            history=history, motion_mm=float(motion[0].quantile(0.95)) if motion else None, failure=failure
        )

    def _prepare_regularizer(self, lengths: Lengths) -> tuple[OffsetRegularizer, LargeSteps]:
        """The penalties on offsets and the preconditioner for a stage's lengths, region by region."""
        skin, device = self.context.skin, self.context.device
        factors = np.array([1.0, *(region.length for region in self.context.recipe.regions)])[skin.region]
        smoothing = factors * lengths.smoothing_mm / MM_PER_M
        if lengths.smoothing_mm > 0:  # less than an edge would not smooth at all where edges are long, as on the scalp
            smoothing = np.maximum(smoothing, skin.edge_length_m)
        regularizer = OffsetRegularizer(
            skin.triangles,
            skin.points,
            half_gain_m=factors * lengths.half_gain_mm / MM_PER_M,
            decay_m=np.full(len(factors), lengths.decay_mm / MM_PER_M),
            device=device,
        )
        steps = LargeSteps(
            skin.triangles, len(factors), edge_length_m=skin.edge_length_m, smoothing_m=smoothing, device=device
        )
        return regularizer, steps

    def _parameter_blocks(self, stage: Stage, names: Sequence[str]) -> list[ParameterBlock]:
        blocks: list[ParameterBlock] = []
        for name, rate in stage.free:
            if name == "offsets":
                assert self.variables.latent is not None
                groups = torch.as_tensor(self.context.skin.region, device=self.context.device)
                fastest = max(1.0, _MAX_STEP_MM / MM_PER_M / rate.start)
                rate_scale = (1.0, *(min(region.rate_scale, fastest) for region in self.context.recipe.regions))
                latent = self.variables.latent.tensor
                blocks.append(AdamUniformBlock(latent, rate, groups=groups, rate_scale=rate_scale))
            elif name in names:
                blocks.append(AdamBlock([self.variables[name]], rate))
        return blocks

    def _losses(self, stage: Stage, terms: Sequence[Term], step: int) -> dict[str, Tensor]:
        """The weighted losses of one step, by name. Updates cameras, texture and exposures too."""
        if self.refinement is not None and self.refinement.is_due(stage, step):
            used, weights = self.landmarks_used, self.view_weights
            self.refinement.update(stage, self.vertices(), self.appearance, weights, used)
        state = self._step_state(stage, step)
        if stage.texture:
            self.appearance.fit_exposures(state.rendered, state.batch, state.agree, state.views)
        losses = {name: loss for term in terms for name, loss in term(state).items()}
        if stage.texture and step % _TEXTURE_STEPS == 0:
            vertices = state.vertices.detach()
            self.appearance.update_texture(vertices, state.rendered, state.batch, state.agree, state.views)
        return losses

    def _step_state(self, stage: Stage, step: int) -> StepState:
        """The mesh and its rendering in the views of a step."""
        views = self.context.view_order.take(stage.views_per_step)
        batch = self._batch(stage.level, views)
        skin_offsets = self.variables.skin_offsets()
        vertices = self.variables.vertices(skin_offsets)
        texture = self.appearance.texture if stage.weights.rgb > 0 or stage.texture else None
        rendered = self.context.renderer(vertices, texture, batch.pixels)
        return StepState(
            step=step,
            views=views,
            batch=batch,
            skin_offsets=skin_offsets,
            vertices=vertices,
            rendered=rendered,
            agree=image.pixel_agreement(rendered, batch, self.context.separate_surfaces),
        )

    def _batch(self, level: int, views: Sequence[int]) -> Targets:
        """The targets of some views with their weights."""
        return self.view_weights.apply(self.pyramid[level].select(views, self.context.device), views)

    def _all_views(self, stage: Stage) -> list[tuple[Targets, Tensor]]:
        """All views in batches, and the pixels where they agree with the mesh as it is."""
        batches, count, vertices = [], self.context.view_count, self.vertices()
        for first in range(0, count, stage.views_per_step):
            batch = self._batch(stage.level, range(first, min(first + stage.views_per_step, count)))
            with torch.no_grad():
                rendered = self.context.renderer(vertices, None, batch.pixels)
            batches.append((batch, image.pixel_agreement(rendered, batch, self.context.separate_surfaces)))
        return batches

    def view_errors(self) -> ViewErrors:
        """Return how far each view is from the mesh, at the coarsest level."""
        targets, vertices = self._coarsest_targets(), self.vertices()
        with torch.no_grad():
            rendered = self.context.renderer(vertices, None, targets.pixels)
        residuals = self._landmark_residuals_by_view(vertices)
        disagreement = {name: self._disagreement_px(name, residual_px) for name, residual_px in residuals.items()}
        return view_errors(rendered, targets, self._median_by_view(disagreement, vertices))

    def landmark_px_by_view(self) -> Float[Tensor, "N"]:
        """Return the median distance of each view's landmarks from the mesh's, px at 512 px of head height.

        Distances of landmarks whose spread exceeds 3 px count as those of landmarks of 3 px: in proportion to it.
        """
        vertices = self.vertices()
        return self._median_by_view(self._landmark_residuals_by_view(vertices), vertices)

    def _median_by_view(
        self, residuals_px: Mapping[str, Float[Tensor, "N L"]], vertices: Float[Tensor, "V 3"]
    ) -> Float[Tensor, "N"]:
        """Over all schemes; NaN without landmarks."""
        if not residuals_px:
            return torch.full((self.context.view_count,), torch.nan)
        relative = [residual_px * self._tolerance(name, vertices) for name, residual_px in residuals_px.items()]
        return torch.cat(relative, 1).nanmedian(1).values

    def _coarsest_targets(self) -> Targets:
        return self.pyramid[-1].select(range(self.context.view_count), self.context.device)

    def _landmark_residuals_by_view(self, vertices: Float[Tensor, "V 3"]) -> dict[str, Float[Tensor, "N L"]]:
        """Per scheme, px at 512 px of head height; NaN where not detected or not used."""
        finest, residuals = self.pyramid[0], {}
        for name, scheme in self.context.captured_schemes.items():
            detected = finest.landmarks[name].to(self.context.device)
            residual_px, counted = landmark.residuals(
                finest.pixels.cameras, scheme.points(vertices), detected, finest.px_per_head
            )
            used = (counted > 0) & torch.as_tensor(self.landmarks_used[name], device=self.context.device)
            residuals[name] = torch.where(used, residual_px, torch.nan)
        return residuals

    def _disagreement_px(self, scheme: str, residual_px: Float[Tensor, "N L"]) -> Float[Tensor, "N L"]:
        """The residuals from the mesh, or from where the views locate the landmark, whichever are smaller.

        The mesh may be wrong at a landmark, or the scheme's definition of it: the views that see it, perhaps only
        those of one side, agree with one another and not with the mesh. That is no fault of theirs.
        """
        points = self.context.triangulated.get(scheme)
        if points is None:
            return residual_px
        finest = self.pyramid[0]
        detected, located = (
            torch.as_tensor(values, dtype=residual_px.dtype, device=residual_px.device)
            for values in (finest.landmarks[scheme], points)
        )
        distance_px, counted = landmark.residuals(finest.pixels.cameras, located, detected, finest.px_per_head)
        agree = (counted > 0) & (distance_px < MIN_ERROR_PX)  # not where it could not be triangulated: NaN
        located_px = torch.where(agree.sum(0) >= _AGREEING_VIEWS, distance_px, torch.inf)
        return torch.where(residual_px.isnan(), torch.nan, torch.minimum(residual_px, located_px))

    def _tolerance(self, name: str, vertices: Float[Tensor, "V 3"]) -> Float[Tensor, "N L"] | float:
        """Factor of the residuals of vague landmarks, so that the limits for those of 3 px hold for them too."""
        finest, scheme = self.pyramid[0], self.context.schemes[name]
        spread = landmark.Spread.of(name, finest, scheme.spread_m)
        if spread is None:
            return 1.0
        total_px = spread.to(vertices.device).total_px(finest.pixels.cameras, scheme.points(vertices))
        return (landmark.UNKNOWN_PX * finest.px_per_head / HEAD_PX / total_px).clamp_max(1.0)

    def landmark_residuals_px(self, triangulated: Mapping[str, Float[np.ndarray, "L 3"]]) -> dict[str, float]:
        """Return the median distance of the used landmarks from their points on the mesh, per scheme.

        Triangulated landmarks average the noise of the detections in single views, which does not shrink however well
        the mesh fits.

        Args:
            triangulated: scheme -> points in the world, metres; NaN where they could not be triangulated.

        Returns:
            Scheme -> px at 512 px of head height; NaN for a scheme without a triangulated landmark.
        """
        finest, mesh, residuals = self.pyramid[0], self.vertices().double().cpu().numpy(), {}
        for name, scheme in self.context.captured_schemes.items():
            points = scheme.points(mesh)
            distance = np.linalg.norm(points - triangulated[name], axis=1)[self.landmarks_used[name]]
            depths = [camera.project(points.mean(0)[None])[1][0] for camera in finest.pixels.cameras]
            focals = [camera.intrinsics[0, 0] for camera in finest.pixels.cameras]
            px_per_m = float(np.median(np.divide(focals, depths))) * HEAD_PX / finest.px_per_head
            distance = distance[np.isfinite(distance)]
            residuals[name] = float(np.median(distance)) * px_per_m if len(distance) else float("nan")
        return residuals

    def depth_mm_by_view(self, targets: Targets, rendered: Rendered) -> Float[Tensor, "N"] | None:
        """Return the median distance of each view's depths from the mesh; NaN without any; None: no view has depths.

        Args:
            targets: of some views.
            rendered: the mesh as it is at their pixels.
        """
        if targets.depth is None:
            return None
        agree = image.pixel_agreement(rendered, targets, self.context.separate_surfaces)
        hits, distance, _ = self.context.depth_distances(self.vertices(), rendered, targets, agree)
        view, size_mm = targets.pixels.view.index_select(0, hits.pixel), distance.abs() * MM_PER_M
        return torch.stack([size_mm[view == number].nanmedian() for number in range(len(targets.names))])

    def landmark_deviations(self, triangulated: Mapping[str, Float[np.ndarray, "L 3"]]) -> dict[str, float]:
        """Return the same median distances in standard deviations along one axis, of schemes whose spread is known.

        Args:
            triangulated: as for `landmark_residuals_px`.

        Returns:
            Scheme -> number of standard deviations; 1.5 is expected of a perfect fit.
        """
        mesh, deviations = self.vertices().double().cpu().numpy(), {}
        for name, scheme in self.context.captured_schemes.items():
            if (spread_m := self.context.landmark_spread_m(name)) is None:
                continue
            distance = np.linalg.norm(scheme.points(mesh) - triangulated[name], axis=1)
            relative = (distance / spread_m)[self.landmarks_used[name]]
            relative = relative[np.isfinite(relative)]
            deviations[name] = float(np.median(relative)) if len(relative) else float("nan")
        return deviations

    def render_views(self, views: Sequence[int]) -> tuple[Targets, Rendered]:
        """Return targets of some views at the finest level, and the mesh rendered there, exposed as their cameras."""
        batch = self.pyramid[0].select(views, self.context.device)
        with torch.no_grad():
            rendered = self.context.renderer(self.vertices(), self.appearance.texture, batch.pixels)
            return batch, self.appearance.apply_exposure(rendered, batch, views)


def assess(context: FitContext, initial: InitialGuess) -> PoseCandidate:
    """Return how well an initial guess covers the coarsest targets of all views."""
    problem = FitProblem(context, initial)
    targets = problem._coarsest_targets()
    with torch.no_grad():
        rendered = context.renderer(problem.vertices(), None, targets.pixels)
        return rate_candidate(initial, rendered, targets)


def refine(context: FitContext, initial: InitialGuess) -> InitialGuess:
    """Return the initial guess with a better pose, and size if the recipe frees it, fitted to the images alone."""
    problem = FitProblem(context, initial)
    problem._run_stage(rigid_stage(len(context.pyramid) - 1), lambda stage, step: None)
    variables = problem.variables
    position, scale = variables["position"].detach().cpu().numpy(), float(variables["scale"].detach().exp())
    return replace(initial, rotation=variables.rotation().detach().cpu().numpy(), position=position, scale=scale)
