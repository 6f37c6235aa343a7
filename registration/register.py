"""The public entry: one capture in, one registration out."""

import time
from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float

from registration.capture.doctor import validate
from registration.capture.native import read
from registration.capture.triangulation import triangulate
from registration.errors import InputError
from registration.evaluate.audit import audit
from registration.evaluate.evaluation import Evaluation, evaluate
from registration.fit.initialization import LEAST_LANDMARKS, LEAST_OVERLAP, from_landmarks, from_masks, spread_views
from registration.fit.problem import Fit, Outcome
from registration.fit.recipes import Recipe, Stage, expression_of, recipe_named
from registration.fit.variables import Start, pivot, start_of
from registration.fit.view_weights import ViewErrors
from registration.geometry.topology import edges
from registration.model import gnm_npz
from registration.model.atlas import texture_atlas
from registration.model.gnm import GNM
from registration.model.landmarks import LandmarkScheme, read_scheme, schemes_beside
from registration.model.regions import exterior, vertex_classes
from registration.progress import Progress, Silent
from registration.render import backend
from registration.report.inputs import ReportInputs, heat_map, report_views
from registration.report.page import write_report
from registration.report.stage_snapshots import write_stage
from registration.storage import hashing
from registration.storage.registration_folder import (
    check_output_folder,
    find_existing,
    load_registration,
    save_registration,
)
from registration.targets.classes import BACKGROUND, class_map
from registration.targets.pyramid import build_pyramid
from registration.types import Capture, Parameters, Registration, Status

SETTLED_MM = 0.05  # 95th percentile of vertex motion over the last tenth of the last stage
LANDMARK_PX = 3.0  # median residual at 512 px of head height
_MANY = 2  # times LANDMARK_PX: views this far off are named
_REPORT_VIEWS = 8
_STAGE_VIEWS = 3


@dataclass(frozen=True, kw_only=True)
class Inputs:
    """All that a registration is made from, read and checked."""

    capture: Capture
    data: gnm_npz.GNMData
    schemes: Mapping[str, LandmarkScheme]
    landmarks: Mapping[str, Float[np.ndarray, "L 3"]]  # triangulated, of the schemes that capture and model share
    recipe: Recipe
    neutral: Registration | None
    digests: Mapping[str, str]  # of the input files
    config: Mapping[str, Any]  # resolved; decides the result together with the digests


def register(
    capture_path: Path,
    *,
    model_path: Path,
    out: Path,
    recipe: str | Recipe = "draft",
    views: int | None = None,
    seed: int = 0,
    neutral: Path | None = None,
    deterministic: bool = False,
    force: bool = False,
    variant: backend.Variant = "llvm",
    landmark_files: Mapping[str, Path] | None = None,
    pictures: Path | None = None,
    progress: Progress | None = None,
) -> Registration:
    """Register one capture and write the registration folder `out`.

    Args:
        capture_path: a native capture folder.
        model_path: an official GNM NPZ file; landmark schemes lie beside it.
        out: replaced if we wrote it before; returned at once if it was made from the same inputs.
        recipe: "preview", "draft", "studio", "in_model", or one of your own.
        views: use only so many views, spread around the head.
        seed: of view subsets and silhouette samples.
        neutral: folder of the subject's neutral registration: its identity, offsets and texture are the start, and
            its identity stays.
        deterministic: every array equal from run to run, for about twice the time.
        force: compute even if `out` already holds this result.
        variant: "llvm" (CPU) or "cuda".
        landmark_files: scheme name -> file, instead of those beside the model.
        pictures: a folder for a picture and the mesh of the fit at its start and after each stage, for debugging.
        progress: where to report to.

    Returns:
        The registration as written; its status says whether it converged.

    Raises:
        InputError: something cannot be used; nothing is computed or written.
    """
    progress = progress or Silent()
    check_output_folder(out)
    inputs = _read_inputs(
        Path(capture_path),
        Path(model_path),
        recipe,
        views,
        None if neutral is None else Path(neutral),
        {name: Path(file) for name, file in (landmark_files or {}).items()},
        {"seed": seed, "deterministic": deterministic, "variant": variant},
    )
    digest = hashing.input_hash(inputs.digests, inputs.config)
    if not force and (same := find_existing(out, digest)) is not None:
        progress.note(f"{out} already holds the registration of these inputs")
        return same
    device = backend.activate(variant, deterministic=deterministic)
    torch.manual_seed(seed)
    fit, start, outcome = _fit(inputs, seed, device, pictures, progress)
    registration = _collect(inputs, fit, start, outcome)
    registration, page = _judge(inputs, fit, registration, progress)
    save_registration(registration, out, page)
    return registration


def _read_inputs(
    capture_path: Path,
    model_path: Path,
    wanted: str | Recipe,
    views: int | None,
    neutral_path: Path | None,
    landmark_files: Mapping[str, Path],
    settings: Mapping[str, Any],
) -> Inputs:
    """Read and check everything; only landmarks are triangulated."""
    recipe = recipe_named(wanted) if isinstance(wanted, str) else wanted
    capture = read(capture_path)
    validate(capture)
    if views is not None:
        capture = _some_views(capture, views)
    data = gnm_npz.read(model_path)
    _check_parts(data)
    neutral = None
    if neutral_path is not None:
        neutral = load_registration(neutral_path)
        _check_topology(neutral, data, neutral_path, model_path)
        recipe = expression_of(recipe)
    count = len(data.template_vertex_positions)
    schemes = schemes_beside(model_path, count)
    schemes |= {name: read_scheme(file, count, name) for name, file in landmark_files.items()}
    landmarks = _landmarks(capture, schemes)
    _check_start(capture, landmarks)
    digests = {"capture": hashing.hash_capture(capture), "model": gnm_npz.content_hash(data)}
    digests |= {f"landmarks {name}": hashing.hash_arrays(s.indices, s.weights) for name, s in schemes.items()}
    if neutral is not None:
        digests["neutral"] = hashing.hash_arrays(neutral.identity, neutral.offsets, neutral.vertices, neutral.texture)
    config = {"recipe": hashing.to_jsonable(recipe), "views": [view.name for view in capture.views], **settings}
    return Inputs(
        capture=capture,
        data=data,
        schemes=schemes,
        landmarks=landmarks,
        recipe=recipe,
        neutral=neutral,
        digests=digests,
        config=config,
    )


def _some_views(capture: Capture, count: int) -> Capture:
    if count < 2:
        raise InputError("Too few views", where="views", expected="at least 2", got=count, fix="use at least two views")
    chosen = spread_views([view.camera for view in capture.views], count)
    return replace(capture, views=tuple(capture.views[i] for i in chosen))


def _landmarks(capture: Capture, schemes: Mapping[str, LandmarkScheme]) -> dict[str, Float[np.ndarray, "L 3"]]:
    """Triangulated landmarks (world, metres; NaN = unseen) of every scheme that capture and model share."""
    solved = {}
    for name in sorted({name for view in capture.views for name in view.landmarks} & set(schemes)):
        solved[name] = triangulate(capture, name)[0]
        expected = len(schemes[name].indices)
        if len(solved[name]) != expected:
            raise InputError(
                "Landmarks of another length than the model's scheme",
                where=f"scheme {name} of {capture.root}",
                expected=f"{expected} landmarks",
                got=len(solved[name]),
                fix=f"name the scheme otherwise, or give the model's with --landmarks {name}=FILE",
            )
    return solved


def _check_parts(data: gnm_npz.GNMData) -> None:
    """Raise now what the fit would trip over: missing vertex groups or components, a mesh that is no manifold."""
    vertex_classes(data)
    pivot(data)
    texture_atlas(data)
    edges(data.triangles)


def _check_start(capture: Capture, landmarks: Mapping[str, Float[np.ndarray, "L 3"]]) -> None:
    counts = {name: int(np.isfinite(points).all(1).sum()) for name, points in landmarks.items()}
    labelled = BACKGROUND in capture.classes and any(view.segmentation for view in capture.views)
    if max(counts.values(), default=0) < LEAST_LANDMARKS and not labelled and not any(v.mask for v in capture.views):
        found = [f"{count} triangulated of scheme {name}" for name, count in counts.items()]
        raise InputError(
            "Nothing tells where the head is",
            where=capture.root,
            expected=f"{LEAST_LANDMARKS} landmarks of a scheme that the model knows, or masks",
            got=", ".join([*(found or ["no landmarks that the model knows"]), "no masks"]),
            fix="add masks (or label maps with a background), landmarks, or the model's landmarks with --landmarks",
        )


def _check_topology(neutral: Registration, data: gnm_npz.GNMData, neutral_path: Path, model_path: Path) -> None:
    same = gnm_npz.topology_hash(neutral.triangles) == gnm_npz.topology_hash(data.triangles)
    sizes = (len(neutral.identity), len(neutral.expression), len(neutral.vertices))
    expected = (len(data.vertex_identity_basis), len(data.expression_basis), len(data.template_vertex_positions))
    if not same or sizes != expected:
        raise InputError(
            "The neutral was registered with another model",
            where=neutral_path,
            expected=f"identity, expression, vertices {expected} and the triangles of {model_path}",
            got=f"{sizes}, {'the same' if same else 'other'} triangles",
            fix="register the neutral with this model first",
        )


def _fit(
    inputs: Inputs, seed: int, device: torch.device, pictures: Path | None, progress: Progress
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


def _start(inputs: Inputs, fit: Fit, progress: Progress) -> Start:
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


def _collect(inputs: Inputs, fit: Fit, start: Start, outcome: Outcome) -> Registration:
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


def _judge(inputs: Inputs, fit: Fit, registration: Registration, progress: Progress) -> tuple[Registration, str]:
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
