"""The public entry: one capture in, one registration out."""

import time
from collections.abc import Collection, Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from registration.evaluate.audit import audit
from registration.evaluate.evaluation import Evaluation, evaluate
from registration.fit.initialization import LEAST_LANDMARKS, LEAST_OVERLAP, from_landmarks, from_masks, spread_views
from registration.fit.problem import Fit, Outcome
from registration.fit.recipes import Stage
from registration.fit.variables import Start, start_of
from registration.fit.view_weights import ViewErrors
from registration.inputs import RegistrationInputs, read_inputs
from registration.model.atlas import texture_atlas
from registration.model.gnm import GNM
from registration.model.regions import exterior
from registration.options import RegisterOptions
from registration.progress import Progress, Silent
from registration.render import backend
from registration.report.inputs import ReportInputs, heat_map, report_views
from registration.report.page import write_report
from registration.report.stage_snapshots import write_stage
from registration.storage import hashing
from registration.storage.registration_folder import check_output_folder, find_existing, save_registration
from registration.targets.classes import class_map
from registration.targets.pyramid import build_pyramid
from registration.types import Parameters, Registration, Status

SETTLED_MM = 0.05  # 95th percentile of vertex motion over the last tenth of the last stage
LANDMARK_PX = 3.0  # median residual at 512 px of head height
_MANY = 2  # times LANDMARK_PX: views this far off are named
_REPORT_VIEWS = 8
_STAGE_VIEWS = 3


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
    progress = progress or Silent()
    out = Path(out)
    check_output_folder(out)
    inputs = read_inputs(Path(capture), Path(model), options, None if neutral is None else Path(neutral))
    if not force and (same := find_existing(out, inputs.input_hash)) is not None:
        progress.note(f"{out} already holds the registration of these inputs")
        return same
    device = backend.activate(options.variant, deterministic=options.deterministic)
    torch.manual_seed(options.seed)
    fit, start, outcome = _fit(inputs, options.seed, device, pictures, progress)
    registration = _collect(inputs, fit, start, outcome)
    registration, page = _judge(inputs, fit, registration, progress)
    save_registration(registration, out, page)
    return registration


def _fit(
    inputs: RegistrationInputs, seed: int, device: torch.device, pictures: Path | None, progress: Progress
) -> tuple[Fit, Start, Outcome]:
    """Read the targets, find the start, run the stages."""
    begun = time.perf_counter()
    mapping = class_map(inputs.capture.classes)
    recipe, count = inputs.recipe, len(inputs.capture.views)

    def reading(done: int) -> None:
        progress.at(done, count, "reading views")

    pyramid = build_pyramid(
        inputs.capture, mapping, finest_head_px=recipe.finest_head_px, levels=recipe.levels, progress=reading
    )
    outcome = Outcome()
    outcome.seconds["targets"] = time.perf_counter() - begun
    begun = time.perf_counter()
    corner_uvs = texture_atlas(inputs.data)
    model = GNM(inputs.data, device=device)
    fit = Fit(inputs.data, model, pyramid, mapping, inputs.schemes, corner_uvs, recipe, seed)
    start = _start(inputs, fit, progress)
    for note in start.notes:
        progress.note(note)
    fit.begin(start, inputs.neutral)
    outcome.seconds["start"] = time.perf_counter() - begun
    total, done = sum(stage.steps for stage in recipe.stages), 0

    shown = spread_views([v.camera for v in inputs.capture.views], _STAGE_VIEWS)
    drawn = ["start"]

    def draw(at: str) -> None:
        """What the fit looks like when `at` begins, under the name of what was before."""
        if pictures is not None and at != drawn[-1]:
            views, vertices = report_views(*fit.picture(shown)), fit.vertices().cpu().numpy()
            write_stage(pictures, f"{len(drawn) - 1:02d}_{drawn[-1]}", views, vertices, inputs.data.triangles)
            drawn.append(at)

    def on_step(stage: Stage, step: int) -> None:
        nonlocal done
        draw(stage.name)
        done += 1
        progress.at(done, total, stage.name)

    fit.run(recipe.stages, outcome, on_step)
    draw("end")
    return fit, start, outcome


def _start(inputs: RegistrationInputs, fit: Fit, progress: Progress) -> Start:
    """From landmarks if the model knows a scheme of the capture's, from the neutral's pose, or from the masks."""
    neutral = None
    if inputs.neutral is not None:
        neutral = start_of(_parameters(inputs.neutral), inputs.neutral.offsets, fit.model, inputs.data)
    skipped = {name for view in inputs.capture.views for name in view.landmarks} - set(inputs.schemes)
    if skipped:
        progress.note(f"landmark schemes that the model does not know, skipped: {', '.join(sorted(skipped))}")
    seen = {name: int(np.isfinite(points).all(1).sum()) for name, points in inputs.landmarks.items()}
    best = max(seen, key=lambda name: seen[name], default=None)
    if best is not None and seen[best] >= LEAST_LANDMARKS:
        start = from_landmarks(
            inputs.data,
            inputs.schemes[best],
            inputs.landmarks[best],
            free_scale=inputs.recipe.scale,
            neutral=neutral,
        )
        assert start.landmarks_used is not None
        fit.landmark_use[best] = start.landmarks_used
        return start
    if neutral is not None and fit.assess(neutral).overlap >= LEAST_OVERLAP:
        return replace(neutral, notes=("no landmarks: starting from the neutral's pose",))
    progress.note("no landmarks that the model knows: searching the head's pose in the masks")
    return from_masks(inputs.data, fit.pyramid[-1], fit.assess, fit.refine)


def _parameters(registration: Registration) -> Parameters:
    names = ("identity", "expression", "rotations", "translation", "scale")
    return Parameters(**{name: torch.as_tensor(np.asarray(getattr(registration, name))) for name in names})


def _collect(inputs: RegistrationInputs, fit: Fit, start: Start, outcome: Outcome) -> Registration:
    """The result as arrays, with its status."""
    parameters, offsets = fit.unknowns.parameters()
    positions = fit.vertices()
    vertices, errors = positions.cpu().numpy(), fit.view_errors()
    landmark_px = fit.landmark_misfits(inputs.landmarks)
    skin = exterior(inputs.data)
    inside = [name for name, scheme in inputs.schemes.items() if not skin[scheme.indices].any()]
    status, reason = _status(outcome, landmark_px, inside, errors)

    def array(value: torch.Tensor) -> np.ndarray:
        return value.detach().cpu().numpy().astype(np.float32)

    return Registration(
        status=status,
        reason=reason,
        identity=array(parameters.identity),
        expression=array(parameters.expression),
        rotations=array(parameters.rotations),
        translation=array(parameters.translation),
        scale=array(parameters.scale),
        offsets=array(offsets),
        vertices=vertices,
        triangles=inputs.data.triangles,
        confidence=fit.confidence() if np.isfinite(vertices).all() else np.zeros(len(vertices), np.float32),
        texture=array(fit.appearance.texture),
        corner_uvs=fit.corner_uvs,
        landmarks={name: scheme.points(vertices) for name, scheme in inputs.schemes.items()},
        seconds=outcome.seconds,
        history=outcome.history,
        figures={
            "motion_mm": outcome.motion_mm,
            "landmark_residual_px": landmark_px,
            "camera_gains": fit.appearance.gains.cpu().numpy().round(4).tolist(),
            "views_not_trusted": dict(fit.trust.notes),
            "notes": list(start.notes),
        },
        config=inputs.config,
        inputs=inputs.digests,
    )


def _status(
    outcome: Outcome, landmark_px: Mapping[str, float], inside: Collection[str], errors: ViewErrors
) -> tuple[Status, str]:
    """Landmarks `inside`, on teeth and tongue, are told but fail nothing: there are no offsets, and of teeth that the
    neutral did not show no expression can mend the place."""
    if outcome.failure:
        return "failed", outcome.failure
    off = {
        name: f"landmarks of scheme {name} are {px:.1f} px off in the median (limit {LANDMARK_PX})"
        for name, px in sorted(landmark_px.items(), key=lambda item: -item[1])
        if px >= LANDMARK_PX
    }
    status: Status
    if off.keys() - inside:
        status, reasons = "failed", [told for name, told in off.items() if name not in inside]
    elif outcome.motion_mm >= SETTLED_MM:
        moved = f"vertices still moved by {outcome.motion_mm:.3f} mm at the end (limit {SETTLED_MM})"
        status, reasons = "stopped", [moved]
    else:
        moved = f"vertices moved by {outcome.motion_mm:.3f} mm over the last tenth of the last stage"
        return "converged", "; ".join([moved, *off.values()])
    views = errors.disagreement(LANDMARK_PX * _MANY)
    return status, "; ".join([*reasons, views] if views else reasons)


def _judge(
    inputs: RegistrationInputs, fit: Fit, registration: Registration, progress: Progress
) -> tuple[Registration, str]:
    """Figures against the scan, if there is one, and the report."""
    evaluation: Evaluation | None = None
    finite = np.isfinite(registration.vertices).all()
    if finite:
        progress.note("auditing parts that may run through one another")
        found = audit(registration.vertices, inputs.data, scale=float(registration.scale)).figures
        registration = replace(registration, figures={**registration.figures, "intersections": found})
    if inputs.capture.scan is not None and finite:
        progress.note("measuring against the scan")
        evaluation = evaluate(registration, inputs.capture)
        registration = replace(registration, figures={**registration.figures, **evaluation.figures})
    progress.note("drawing the report")
    batch, rendered = fit.picture(spread_views([v.camera for v in inputs.capture.views], _REPORT_VIEWS))
    page = write_report(
        ReportInputs(
            registration=registration,
            subject=inputs.capture.subject,
            expression=inputs.capture.expression,
            views=report_views(batch, rendered),
            class_names=batch.class_names,
            heat_map=None if evaluation is None else heat_map(registration, evaluation.vertex_distance_mm),
            versions=hashing.versions(),
        )
    )
    return registration, page
