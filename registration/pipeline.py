"""Register one capture: read the inputs, fit, evaluate, write the folder."""

import shlex
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float

from registration.capture.origin import in_world
from registration.capture.visual_hull import outside_masks
from registration.completion.saved import Completion
from registration.cranium.complete import CompletedCranium, CraniumCompletion
from registration.cranium.registered import NEUTRAL, cranium_figure, cranium_note, write_cranium
from registration.evaluate.audit import audit_penetration
from registration.evaluate.evaluation import RegistrationEvaluation, evaluate_registration, without_scan
from registration.evaluate.folds import fold_figures
from registration.evaluate.plausibility import plausibility
from registration.evaluate.residuals import far_landmarks
from registration.evaluate.reversed_skin import reversed_figures
from registration.evaluate.verdict import judge
from registration.evaluate.viewpoint import intersection_figures
from registration.fit import camera_refinement
from registration.fit.context import FitContext
from registration.fit.landmark_start import seen_landmarks
from registration.fit.problem import FitProblem, FitTrace
from registration.fit.recipes import Stage
from registration.fit.start import initial_guess
from registration.fit.status import judge_fit
from registration.fit.variables import InitialGuess
from registration.geometry.nearest_planes import CloudPlanes, MeshPlanes, NearestPlanes
from registration.geometry.surface_views import SurfaceViews
from registration.inputs import RegistrationInputs, read_inputs
from registration.model.atlas import texture_atlas
from registration.model.gnm import GNM
from registration.model.regions import exterior
from registration.options import RegisterOptions
from registration.preparation import complete_inputs
from registration.progress import NullProgress, Progress
from registration.render import backend
from registration.report.comparison import Comparison, compare_views
from registration.report.inputs import ReportInputs, distance_heat_map
from registration.report.page import render_report
from registration.report.stage_snapshots import StageSnapshots
from registration.storage import hashing
from registration.storage.registration_folder import (
    FILES,
    REPORT,
    check_output_folder,
    find_existing,
    save_registration,
)
from registration.targets.classes import class_map
from registration.targets.pyramid import build_pyramid
from registration.types import Camera, HeadPose, Registration


def register(
    capture: Path,
    model: Path,
    out: Path,
    options: RegisterOptions = RegisterOptions(),  # noqa: B008  frozen
    *,
    neutral: Path | None = None,
    force: bool = False,
    pictures: Path | None = None,
    progress: Progress | None = None,
) -> Registration:
    """Register one capture and write the registration folder `out`.

    Args:
        capture: a native capture folder.
        model: an official GNM NPZ file; landmark schemes lie next to it.
        out: replaced if it is a registration; returned at once if it was made from the same inputs.
        options: recipe, views, seed and the like.
        neutral: folder of the subject's neutral registration: its identity, offsets and texture are the initial
            guess, and its identity stays.
        force: compute even if `out` already holds this result.
        pictures: a folder for an image and the mesh of the fit at its start and after each stage, for debugging.
        progress: where to report to.

    Returns:
        The registration as written; its status says whether it converged.

    Raises:
        InputError: something cannot be used; nothing is computed or written.
    """
    progress = progress or NullProgress()
    out = Path(out)
    check_output_folder(out)
    inputs = read_inputs(Path(capture), Path(model), options, None if neutral is None else Path(neutral))
    for warning in (*inputs.ledger.warnings, *inputs.ledger.unread):
        progress.message(f"warning: {warning}")
    if not force and (same := find_existing(out, inputs.input_hash)) is not None:
        progress.message(f"{out} already holds the registration of these inputs")
        return same
    device = backend.activate(options.variant, deterministic=options.deterministic)
    torch.manual_seed(options.seed)
    inputs, completion = complete_inputs(inputs, options, device, progress)
    fitted = _fit(inputs, options.seed, device, pictures, progress)
    progress.message("comparing with the views")
    comparison = compare_views(fitted.problem)
    cranium, figure = _complete_cranium(inputs, fitted.problem, comparison.confidence)
    if cranium is not None:
        progress.message("comparing with the views, with the completed cranium")
        comparison = compare_views(fitted.problem)
    provenance = _provenance(capture, model, out, options, neutral)
    collected = _with_made(replace(_collect(inputs, fitted, comparison), provenance=provenance), completion)
    note = cranium_note(figure, wanted=options.cranium == "model", neutral=neutral is not None)
    notes = [*collected.figures["notes"], *([] if note is None else [note])]
    collected = replace(collected, figures={**collected.figures, "cranium": figure, "notes": notes})
    registration, page = _evaluate(inputs, comparison, collected, completion, progress)
    save_registration(
        registration,
        out,
        page,
        camera_refinement.writer(fitted.problem.refinement, inputs.capture),
        None if cranium is None else partial(write_cranium, cranium),
    )
    return registration


def _provenance(
    capture: Path, model: Path, out: Path, options: RegisterOptions, neutral: Path | None
) -> dict[str, str]:
    """The command that makes this registration, and the absolute paths in it."""
    given = {"capture": capture, "model": model, "neutral": neutral}
    paths = {name: str(Path(path).absolute()) for name, path in given.items() if path is not None}
    words = ["gnmreg", "register", paths["capture"], "--model", paths["model"], "--out", str(out.absolute())]
    words += ["--neutral", paths["neutral"]] if neutral is not None else []
    return {"command": shlex.join([*words, *options.arguments()]), **paths}


def _with_made(registration: Registration, completion: Completion | None) -> Registration:
    """The registration with what was made for it: figures, notes, durations, and where the files are."""
    if completion is None:
        return registration
    figures = {**registration.figures, "made": completion.figures}
    figures["notes"] = [*completion.notes, *figures["notes"]]
    seconds = {**{f"made: {step}": value for step, value in completion.seconds.items()}, **registration.seconds}
    provenance = {**registration.provenance, "made": str(completion.folder)}
    return replace(registration, figures=figures, seconds=seconds, provenance=provenance)


@dataclass(frozen=True, kw_only=True, eq=False)
class _Fitted:
    """A fit after its last stage."""

    problem: FitProblem
    initial: InitialGuess
    trace: FitTrace
    seconds: Mapping[str, float]  # part of the work -> duration, in order


def _fit(
    inputs: RegistrationInputs, seed: int, device: torch.device, pictures: Path | None, progress: Progress
) -> _Fitted:
    """Read the targets, estimate the initial guess, run the stages."""
    start_time = time.perf_counter()
    context = _context(inputs, seed, device, progress)
    targets_time = time.perf_counter()
    unknown = {name for view in inputs.capture.views for name in view.landmarks} - set(inputs.schemes)
    if unknown:
        progress.message(f"landmark schemes that the model does not have, ignored: {', '.join(sorted(unknown))}")
    initial = initial_guess(context, _head_pose(inputs))
    for note in (*inputs.notes, *initial.notes):
        progress.message(note)
    problem = FitProblem(context, initial)
    initial_time = time.perf_counter()
    seconds = {"targets": targets_time - start_time, "start": initial_time - targets_time}
    snapshots = None if pictures is None else StageSnapshots(problem, pictures, inputs.origin)
    steps = _StepProgress(inputs.recipe.stages, progress)

    def on_step(stage: Stage, step: int) -> None:
        if snapshots is not None:
            snapshots.stage_begins(stage.name)
        steps.advance(stage.name)

    trace = problem.run(inputs.recipe.stages, on_step)
    if snapshots is not None:
        snapshots.stage_begins("end")
    return _Fitted(problem=problem, initial=initial, trace=trace, seconds={**seconds, **trace.seconds})


def _complete_cranium(
    inputs: RegistrationInputs, problem: FitProblem, confidence: Float[np.ndarray, "V"]
) -> tuple[CompletedCranium | None, dict[str, Any]]:
    """Complete the hidden cranium of a fit in place; return it, None if it stays as it is, and the figure of it."""
    head = problem.vertices().double().cpu().numpy()
    completed = None
    if inputs.cranium is not None and np.isfinite(head).all():
        expression_m = None
        if inputs.capture.expression != NEUTRAL:  # a neutral face is as it looks, whatever coefficients it took
            expression_m = problem.variables.expression_vertices().norm(dim=1).double().cpu().numpy()
        completed = CraniumCompletion(inputs.data, inputs.cranium)(head, confidence, expression_m)
    moved = None
    if completed is not None:
        moved = completed.vertices - head
        problem.variables.move_skin(moved)
    return completed, cranium_figure(inputs.data, confidence, inputs.cranium, completed, moved)


def _context(inputs: RegistrationInputs, seed: int, device: torch.device, progress: Progress) -> FitContext:
    """Decode the views and collect the inputs of the fit."""
    classes, recipe, count = class_map(inputs.capture.classes), inputs.recipe, len(inputs.capture.views)
    capture = inputs.capture.cameras_relative_to(inputs.origin)
    surface, planes = _scan(inputs, [view.camera for view in capture.views])
    pyramid = build_pyramid(
        capture,
        classes,
        finest_head_px=recipe.finest_head_px,
        levels=recipe.levels,
        coarsest_head_px=recipe.coarsest_head_px,
        head_rows=inputs.head_rows,
        surface=surface,
        progress=lambda done: progress.update(done, count, "reading views"),
    )
    return FitContext(
        data=inputs.data,
        model=GNM(inputs.data, device=device),
        pyramid=pyramid,
        classes=classes,
        schemes=inputs.schemes,
        corner_uvs=texture_atlas(inputs.data),
        recipe=recipe,
        seed=seed,
        neutral=None
        if inputs.neutral is None
        else replace(inputs.neutral, translation=inputs.neutral.translation - inputs.origin),
        triangulated={name: points - inputs.origin for name, points in inputs.landmarks.items()},
        triangulated_spread_m=inputs.landmark_spread_m,
        seen_landmarks=seen_landmarks(capture, inputs.schemes),
        scan=planes,
        camera_sigma_px=camera_refinement.level_sigma_px(inputs.camera_sigma_px, inputs.capture, pyramid[0]),
    )


def _head_pose(inputs: RegistrationInputs) -> HeadPose | None:
    """The pose that the capture brings, in the world around the origin."""
    head = inputs.capture.head
    return None if head is None else replace(head, translation=head.translation - inputs.origin)


def _scan(inputs: RegistrationInputs, cameras: Sequence[Camera]) -> tuple[SurfaceViews | None, NearestPlanes | None]:
    """The scan as a source of normals, if it is a mesh, and as a surface to fit, if it is to be."""
    if inputs.scan is None:
        return None, None
    vertices, triangles = inputs.scan.vertices - inputs.origin, inputs.scan.triangles
    foreign = outside_masks(inputs.capture, inputs.scan.vertices)
    surface = SurfaceViews(vertices, triangles, cameras, foreign=foreign) if len(triangles) else None
    if not inputs.fits_scan:
        return surface, None
    return surface, CloudPlanes(vertices[~foreign]) if surface is None else MeshPlanes(surface)


class _StepProgress:
    """Reports the steps of all stages."""

    def __init__(self, stages: Sequence[Stage], progress: Progress):
        self._total, self._done, self._progress = sum(stage.steps for stage in stages), 0, progress

    def advance(self, stage: str) -> None:
        self._done += 1
        self._progress.update(self._done, self._total, stage)


def _collect(inputs: RegistrationInputs, fitted: _Fitted, comparison: Comparison) -> Registration:
    """The result as arrays, with its status."""
    problem, trace = fitted.problem, fitted.trace
    parameters, offsets = problem.variables.parameters()
    vertices, errors = problem.vertices().cpu().numpy(), problem.view_errors()
    local = camera_refinement.located(problem.refinement, inputs.capture, inputs.landmarks, inputs.origin)
    landmark_px, deviations = problem.landmark_residuals_px(local), problem.landmark_deviations(local)
    skin = exterior(inputs.data)
    inside = [name for name, scheme in inputs.schemes.items() if not skin[scheme.indices].any()]
    status, reason = judge_fit(trace, landmark_px, inside, errors, deviations)

    def array(value: torch.Tensor) -> np.ndarray:
        return value.detach().cpu().numpy().astype(np.float32)

    return Registration(
        status=status,
        reason=reason,
        identity=array(parameters.identity),
        expression=array(parameters.expression),
        rotations=array(parameters.rotations),
        translation=in_world(array(parameters.translation), inputs.origin),
        scale=array(parameters.scale),
        offsets=array(offsets),
        vertices=in_world(vertices, inputs.origin),
        triangles=inputs.data.triangles,
        confidence=comparison.confidence,
        texture=array(problem.appearance.texture),
        corner_uvs=problem.context.corner_uvs,
        landmarks={name: in_world(scheme.points(vertices), inputs.origin) for name, scheme in inputs.schemes.items()},
        seconds=fitted.seconds,
        history=trace.history,
        figures={
            "subject": inputs.capture.subject,
            "expression": inputs.capture.expression,
            "motion_mm": trace.motion_mm,
            "landmark_residual_px": landmark_px,
            **({"landmark_residual_sigmas": deviations} if deviations else {}),
            "camera_gains": problem.appearance.gains.cpu().numpy().round(4).tolist(),
            "views_not_trusted": dict(problem.view_weights.notes),
            "notes": [*inputs.notes, *fitted.initial.notes],
            **{name: inputs.capture.tags[name] for name in ("scan_hygiene",) if name in inputs.capture.tags},
            **({"warnings": list(inputs.ledger.warnings)} if inputs.ledger.warnings else {}),
            **camera_refinement.figures(problem.refinement, inputs.capture, inputs.camera_sigma_px),
            **({} if inputs.scan is None else {"scan_in_fit": _scan_in_fit(inputs, problem)}),
            "residuals": comparison.residuals,
        },
        config=inputs.config,
        inputs=inputs.digests,
    )


def _scan_in_fit(inputs: RegistrationInputs, problem: FitProblem) -> dict[str, Any]:
    """What of the scan the fit has used: the views that have its normals, and the share of skin that lies near it."""
    assert inputs.scan is not None
    without = [view.name for view in inputs.capture.views if not view.has_normals]
    distance = problem.context.scan_distance
    return {
        "normals": len(without) if len(inputs.scan.triangles) else 0,
        "surface": None if distance is None else distance.share,
    }


def _evaluate(
    inputs: RegistrationInputs,
    comparison: Comparison,
    registration: Registration,
    completion: Completion | None,
    progress: Progress,
) -> tuple[Registration, str]:
    """The registration with its metrics, including those against a scan, and the report's page."""
    evaluation: RegistrationEvaluation | None = None
    finite = np.isfinite(registration.vertices).all()
    if finite:
        progress.message("auditing intersections between parts, folds and reversed skin")
        vertices = registration.vertices - inputs.origin if inputs.origin.any() else registration.vertices
        audit = audit_penetration(vertices, inputs.data, scale=float(registration.scale))
        shown = {view.name for view in comparison.views}
        cameras = {
            view.name: view.camera.relative_to(inputs.origin) for view in inputs.capture.views if view.name in shown
        }
        intersections = intersection_figures(audit, vertices, cameras)
        folds = fold_figures(vertices, inputs.data, cameras)
        figures = {
            "intersections": intersections,
            "folds": folds,
            "reversed_skin": reversed_figures(vertices, inputs.data, cameras),
            **plausibility(registration, inputs.data, inputs.neutral),
        }
        if (far := far_landmarks(inputs.capture, registration.landmarks)) is not None:
            figures["far_landmarks"] = far
        registration = replace(registration, figures={**registration.figures, **figures})
    if inputs.capture.scan is not None and finite:
        progress.message("measuring against the scan")
        evaluation = evaluate_registration(registration, inputs.capture)
        registration = replace(registration, figures={**registration.figures, **evaluation.metrics})
    elif inputs.capture.scan is None:
        unmeasured = without_scan(inputs.capture)
        registration = replace(registration, figures={**registration.figures, "unmeasured": unmeasured})
    verdict = judge(registration.status, registration.figures).figure
    registration = replace(registration, figures={**registration.figures, "verdict": verdict})
    progress.message("writing the report")
    page = render_report(
        ReportInputs(
            registration=registration,
            subject=inputs.capture.subject,
            expression=inputs.capture.expression,
            views=comparison.views,
            thumbnails=comparison.thumbnails,
            class_names=comparison.class_names,
            heat_map=None if evaluation is None else distance_heat_map(registration, evaluation.vertex_distance_mm),
            versions=hashing.versions(),
            made=None if completion is None else completion.sheet.read_bytes(),
            files={name: meaning for name, meaning in FILES.items() if name != REPORT},
        )
    )
    return registration, page
