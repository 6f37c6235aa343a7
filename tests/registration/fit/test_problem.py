"""The fitting problem on a small synthetic capture: terms, traces, and what is shared between initial guesses."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import pytest
import torch

from registration.capture.scan import read_scan
from registration.fit import problem as problem_module
from registration.fit import terms
from registration.fit.context import FitContext, ViewOrder
from registration.fit.initialization import from_landmarks
from registration.fit.landmark_slide import slide_to_landmarks
from registration.fit.problem import FitProblem, assess, refine
from registration.fit.recipes import Rate, Recipe, Stage, Weights, draft, expression_recipe, preview, studio
from registration.fit.terms import StageContext, StepState, Term
from registration.fit.terms import image as image_terms
from registration.fit.variables import InitialGuess
from registration.geometry.nearest_planes import MeshPlanes
from registration.geometry.rasterizer import visible
from registration.geometry.surface_views import SurfaceViews
from registration.geometry.topology import vertex_normals
from registration.inputs import RegistrationInputs, read_inputs
from registration.model.atlas import texture_atlas
from registration.model.gnm import GNM
from registration.model.landmarks import LandmarkScheme
from registration.model.regions import lids_by_eye, offset_regions
from registration.options import RegisterOptions
from registration.render import backend
from registration.targets.classes import class_map
from registration.targets.pyramid import build_pyramid
from tests.registration.register import synthetic

OFFSETS = {"offset l2", "offset coupling", "offset laplacian"}
IMAGES = {"normals", "mask", "classes", "landmarks 68"}


def short(steps: int = 2) -> Recipe:
    """The preview with few steps."""
    recipe = preview()
    return replace(recipe, stages=tuple(replace(stage, steps=steps, level=1) for stage in recipe.stages[:2]))


@pytest.fixture(scope="module")
def inputs(tmp_path_factory: pytest.TempPathFactory) -> RegistrationInputs:
    truth = synthetic.make(tmp_path_factory.mktemp("fit") / "neutral")
    return read_inputs(truth.root, synthetic.MODEL, RegisterOptions(recipe=short(), views=3))


@pytest.fixture
def context(inputs: RegistrationInputs) -> FitContext:
    device, classes = backend.activate("llvm"), class_map(inputs.capture.classes)
    return FitContext(
        data=inputs.data,
        model=GNM(inputs.data, device=device),
        pyramid=build_pyramid(inputs.capture, classes, finest_head_px=128, levels=2),
        classes=classes,
        schemes=inputs.schemes,
        corner_uvs=texture_atlas(inputs.data),
        recipe=inputs.recipe,
        seed=0,
    )


@pytest.fixture
def initial(inputs: RegistrationInputs) -> InitialGuess:
    return from_landmarks(inputs.data, inputs.schemes["68"], inputs.landmarks["68"], free_scale=True)


def test_stages_have_the_losses_of_their_weights_and_variables(context: FitContext, initial: InitialGuess) -> None:
    trace = FitProblem(context, initial).run(context.recipe.stages)
    model, offsets = context.recipe.stages
    assert trace.failure is None and np.isfinite(trace.motion_mm)
    assert set(trace.history[model.name]) == IMAGES | {"identity", "expression", "joints", "eyes"}
    assert set(trace.history[offsets.name]) == IMAGES | OFFSETS | {"rgb", "eyes", "folds"}
    assert all(len(values) == 2 for losses in trace.history.values() for values in losses.values())
    assert set(trace.seconds) == {model.name, offsets.name}


def test_depths_are_fitted_where_there_are_any(context: FitContext, initial: InitialGuess) -> None:
    """Depths of the truth's mesh draw an initial guess that is moved away from the cameras back."""
    vertices = FitProblem(context, initial).vertices()
    levels = []
    for targets in context.pyramid:
        rendered = context.renderer(vertices, None, targets.pixels)
        hits = context.renderer.surface(vertices, targets.pixels)
        assert rendered.mask.sum() == len(hits.pixel)
        corners = torch.as_tensor(context.data.triangles.astype(np.int64))[hits.face]
        points = (vertices[corners] * hits.barycentric[..., None]).sum(1)
        depth = torch.zeros(len(targets.pixels.view))
        for view, camera in enumerate(targets.pixels.cameras):
            members = targets.pixels.view[hits.pixel] == view
            projected, z = camera.project(points[members].double().numpy())
            pixel = hits.pixel[members]
            centres = torch.stack([targets.pixels.x[pixel], targets.pixels.y[pixel]], -1).numpy() + 0.5
            np.testing.assert_allclose(projected, centres, atol=2e-2)
            depth[pixel] = torch.as_tensor(z, dtype=torch.float32)
        levels.append(replace(targets, depth=depth))
    with_depth = replace(context, pyramid=tuple(levels))
    moved = replace(initial, position=initial.position + np.array([0.002, 0.0, 0.003]))
    only = Weights(normals=0, mask=0, classes=0, landmarks=0, tongue=0, depth_scale_mm=10)
    stage = Stage(name="pose", steps=25, level=1, weights=only, free=(("position", Rate(start=5e-4, end=1e-4)),))
    problem = FitProblem(with_depth, moved)
    before = (problem.vertices() - vertices).norm(dim=-1).mean()
    trace = problem.run([stage])
    after = (problem.vertices() - vertices).norm(dim=-1).mean()
    assert set(trace.history["pose"]) == {"depth"} and after < 0.2 * before


@pytest.mark.parametrize("difference, counts", [(0.3, True), (0.6, False)])
def test_large_differences_of_normals_do_not_count_on_the_lids(
    context: FitContext, initial: InitialGuess, difference: float, counts: bool
) -> None:
    """Normals that all differ by one length: beyond the lids' limit, pixels on lids alone are without cost."""
    problem = FitProblem(context, initial)
    plain = context.recipe.stages[1]
    state = problem._step_state(plain, 0)
    rendered = replace(state.rendered, normals=state.rendered.normals.detach().requires_grad_())
    shown = rendered.normals.detach()
    across = torch.linalg.cross(shown, torch.tensor([0.6, 0.0, 0.8]).expand_as(shown))
    tilt = 2 * np.arcsin(difference / 2)  # of unit vectors whose tips are so far apart
    tilted = np.cos(tilt) * shown + np.sin(tilt) * torch.nn.functional.normalize(across, dim=1)
    batch = replace(state.batch, normals=tilted, normal_weight=rendered.mask.detach())
    state = replace(state, rendered=rendered, batch=batch, agree=torch.ones_like(state.agree))

    def used(truncation: float) -> torch.Tensor:
        """The pixels whose normals have a gradient."""
        stage = replace(plain, weights=Weights(lid_normal_truncation=truncation))
        shared = StageContext(
            fit=context,
            stage=stage,
            variables=problem.variables,
            appearance=problem.appearance,
            landmarks_used=problem.landmarks_used,
            regularizer=None,
        )
        term = image_terms.normals(shared)
        assert term is not None
        (gradient,) = torch.autograd.grad(term(state)["normals"], rendered.normals)
        return gradient.abs().amax(1) > 0

    hits = context.renderer.surface(state.vertices.detach(), batch.pixels)
    members = offset_regions(context.data)["lids"][context.data.triangles[hits.face.numpy()]].any(1)
    on_lids = torch.zeros(len(batch.mask), dtype=torch.bool)
    on_lids[hits.pixel[torch.as_tensor(members)]] = True
    everywhere, limited = used(2.0), used(0.45)
    assert (everywhere & on_lids).sum() > 5 and (everywhere & ~on_lids).sum() > 500
    assert torch.equal(limited, everywhere if counts else everywhere & ~on_lids)


def test_recipes_limit_normals_on_the_lids_while_offsets_are_free() -> None:
    for recipe in (draft(), preview(), studio()):
        for stage in recipe.stages:
            assert (stage.weights.lid_normal_truncation < stage.weights.normal_truncation) == stage.frees("offsets")


def test_a_scan_is_fitted_in_the_finer_stages_only(
    context: FitContext, initial: InitialGuess, inputs: RegistrationInputs
) -> None:
    assert inputs.capture.scan is not None and inputs.scan is None  # there are normal maps
    scan = read_scan(inputs.capture.scan)
    cameras = [view.camera for view in inputs.capture.views]
    planes = MeshPlanes(SurfaceViews(scan.vertices, scan.triangles, cameras))
    stages = tuple(replace(stage, steps=2, level=1) for stage in preview().stages[:3])
    problem = FitProblem(replace(context, scan=planes), initial)
    trace = problem.run(stages)
    assert ["scan" in trace.history[stage.name] for stage in stages] == [False, False, True]
    assert 0 < trace.history[stages[2].name]["scan"][0] < 1
    assert problem.context.scan_distance is not None and 0.2 < problem.context.scan_distance.share < 1


def test_a_new_term_is_a_factory_in_the_list(
    context: FitContext, initial: InitialGuess, monkeypatch: pytest.MonkeyPatch
) -> None:
    def height(stage_context: StageContext) -> Term | None:
        def term(state: StepState) -> Mapping[str, torch.Tensor]:
            return {"height": 10.0 * state.vertices[:, 1].mean()}

        return term if stage_context.stage.frees("position") else None

    before = FitProblem(context, initial)
    before.run(context.recipe.stages[:1])
    monkeypatch.setattr(terms, "TERMS", (*terms.TERMS, height))
    after = FitProblem(replace(context), initial)
    trace = after.run(context.recipe.stages)
    model, offsets = context.recipe.stages
    assert "height" in trace.history[model.name] and "height" not in trace.history[offsets.name]
    assert after.variables["position"][1] < before.variables["position"][1]


def test_a_failed_stage_ends_the_fit_and_is_named(
    context: FitContext, initial: InitialGuess, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(stage_context: StageContext) -> Term | None:
        return lambda state: {"broken": state.vertices.sum() * (torch.nan if state.step == 1 else 0.0)}

    monkeypatch.setattr(terms, "TERMS", (*terms.TERMS, broken))
    steps: list[tuple[str, int]] = []
    trace = FitProblem(context, initial).run(
        context.recipe.stages, lambda stage, step: steps.append((stage.name, step))
    )
    assert trace.failure == "stage model: broken not finite at step 1"
    assert list(trace.history) == ["model"] and steps == [("model", 0)]


def test_offsets_are_a_latent_only_while_a_stage_runs(context: FitContext, initial: InitialGuess) -> None:
    problem = FitProblem(context, initial)
    latent: list[bool] = []
    problem.run(context.recipe.stages, lambda stage, step: latent.append(problem.variables.latent is not None))
    assert latent == [False, False, True, True] and problem.variables.latent is None
    assert problem.variables.skin_offsets().any()


def landmarks_beside(
    problem: FitProblem, spread_m: float, scheme: LandmarkScheme | None = None
) -> tuple[FitContext, np.ndarray]:
    """The problem's context with landmarks 1 mm to the side and 1 mm before the mesh's; and where they are."""
    context = problem.context
    if scheme is not None:
        context = replace(context, schemes={"68": scheme})
    points = context.schemes["68"].points(problem.vertices().double().numpy()) + np.array([1e-3, 0.0, 1e-3])
    spread = np.full(len(points), spread_m)
    return replace(context, triangulated={"68": points}, triangulated_spread_m={"68": spread}), points


@pytest.mark.parametrize("spread_m, share", [(1e-4, (0.75, 1.05)), (2e-2, (0.0, 0.15))])
def test_skin_slides_along_itself_to_landmarks_by_their_spread(
    context: FitContext, initial: InitialGuess, spread_m: float, share: tuple[float, float]
) -> None:
    problem = FitProblem(context, initial)
    with_landmarks, points = landmarks_beside(problem, spread_m)
    before, scheme = problem.vertices(), context.schemes["68"]
    slide_to_landmarks(with_landmarks, problem.variables, problem.landmarks_used)
    moved = (problem.vertices() - before).double().numpy()
    normals = vertex_normals(before, context.triangles).double().numpy()
    across = np.abs((moved * normals).sum(1))[problem.variables.skin]
    assert across.max() < 0.02 * np.linalg.norm(moved, axis=1).max()
    brows = np.arange(17, 27)  # skin that faces forwards
    facing = scheme.points(normals)[brows]
    to_the_side = np.array([1e-3, 0, 1e-3]) - facing * (facing @ [1e-3, 0, 1e-3])[:, None]
    reached = (scheme.points(moved)[brows] * to_the_side).sum() / np.square(to_the_side).sum()
    assert share[0] < reached < share[1]
    others = np.setdiff1d(np.arange(len(moved)), problem.variables.skin)
    assert not moved[others].any()


def test_landmarks_that_are_outliers_or_missing_move_nothing(context: FitContext, initial: InitialGuess) -> None:
    problem = FitProblem(context, initial)
    with_landmarks, points = landmarks_beside(problem, 1e-4)
    before = problem.vertices()
    slide_to_landmarks(context, problem.variables, problem.landmarks_used)
    slide_to_landmarks(with_landmarks, problem.variables, {"68": np.zeros(len(points), bool)})
    missing = replace(with_landmarks, triangulated={"68": np.full_like(points, np.nan)})
    slide_to_landmarks(missing, problem.variables, problem.landmarks_used)
    torch.testing.assert_close(problem.vertices(), before, atol=1e-7, rtol=0)


@pytest.mark.parametrize("seen", [True, False])
def test_landmarks_of_skin_that_no_view_sees_move_nothing(
    context: FitContext, initial: InitialGuess, seen: bool
) -> None:
    """Skin that lies 3 mm behind other skin in every view, or skin that a view sees."""
    problem = FitProblem(context, initial)
    mesh = problem.vertices().double().numpy()
    views = [visible(mesh, mesh, context.data.triangles, camera, 3e-3) for camera in problem.pyramid[0].pixels.cameras]
    places = np.flatnonzero(np.any(views, axis=0) == seen)
    corners = np.intersect1d(places, problem.variables.skin)[:20, None].repeat(3, axis=1)
    scheme = LandmarkScheme(name="68", indices=corners, weights=np.full((len(corners), 3), 1 / 3))
    with_landmarks, _ = landmarks_beside(problem, 1e-4, scheme)
    slide_to_landmarks(with_landmarks, problem.variables, {"68": np.ones(len(corners), bool)})
    moved = (problem.vertices() - torch.as_tensor(mesh)).norm(dim=-1).max()
    assert len(corners) == 20 and (moved > 5e-4) == seen


@pytest.mark.parametrize("closed", [True, False])
def test_landmarks_on_the_lids_of_an_eye_that_no_view_sees_move_nothing(
    context: FitContext, initial: InitialGuess, closed: bool
) -> None:
    """An eyeball behind the forehead is not seen, as between closed lids."""
    problem = FitProblem(context, initial)
    if closed:
        problem.variables["eyes"][0, :3] = torch.tensor([0.0, 0.05, -0.06])
    before = problem.vertices()
    left, right = (np.flatnonzero(lids > 0) for lids in lids_by_eye(context.data))
    for lids, moves in ((left, not closed), (right, True)):
        corners = lids[:, None].repeat(3, axis=1)
        scheme = LandmarkScheme(name="68", indices=corners, weights=np.full((len(lids), 3), 1 / 3))
        with_landmarks, _ = landmarks_beside(problem, 1e-4, scheme)
        slide_to_landmarks(with_landmarks, problem.variables, {"68": np.ones(len(lids), bool)})
        assert bool((problem.vertices() - before).norm(dim=-1).max() > 2e-4) == moves


def test_recipes_slide_once_and_not_for_expressions() -> None:
    for make in (preview, draft, studio):
        assert [stage.name for stage in make().stages if stage.landmark_slide] == ["offsets 5 mm"]
        assert not any(stage.landmark_slide for stage in expression_recipe(make()).stages)


def test_outliers_of_the_initial_guess_do_not_count(context: FitContext, initial: InitialGuess) -> None:
    points = synthetic.read(synthetic.MODEL).template_vertex_positions  # far from the capture's world
    wrong = {"68": context.schemes["68"].points(points)}
    used = np.zeros(68, bool)
    used[:10] = True
    few = FitProblem(context, replace(initial, landmarks_used={"68": used}))
    assert few.landmarks_used["68"].sum() == 10
    partly = {"68": np.where(used[:, None], context.schemes["68"].points(few.vertices().numpy()), wrong["68"])}
    assert few.landmark_residuals_px(partly)["68"] == pytest.approx(0.0, abs=1e-2)
    assert FitProblem(context, initial).landmark_residuals_px(partly)["68"] > 10


def test_a_pose_is_assessed_and_refined_without_touching_other_problems(
    context: FitContext, initial: InitialGuess, monkeypatch: pytest.MonkeyPatch
) -> None:
    shifted = replace(initial, position=initial.position + [0.02, 0.0, 0.0])
    assert assess(context, initial).overlap > assess(context, shifted).overlap + 0.05
    rigid = problem_module.rigid_stage
    monkeypatch.setattr(problem_module, "rigid_stage", lambda level: replace(rigid(level), steps=10))
    refined = refine(context, shifted)
    assert assess(context, refined).overlap > assess(context, shifted).overlap + 0.03
    assert refined.identity is shifted.identity


@pytest.mark.parametrize("texture_px", (64, 4096))
def test_texels_are_no_finer_than_pixels(context: FitContext, initial: InitialGuess, texture_px: int) -> None:
    context = replace(context, recipe=replace(context.recipe, texture_px=texture_px))
    size, head_px = len(FitProblem(context, initial).appearance.texture), context.pyramid[0].px_per_head
    assert size == 64 if texture_px == 64 else 2 * head_px <= size < 4 * head_px


def test_steps_take_all_views_evenly_and_none_twice() -> None:
    centres = np.random.default_rng(0).normal(size=(7, 3))
    order = ViewOrder(centres, seed=3)
    steps = [order.take(3) for _ in range(70)]
    assert all(len(set(step)) == 3 and step == sorted(step) for step in steps)
    counts = np.bincount([view for step in steps for view in step], minlength=7)
    assert counts.sum() == 210 and counts.min() >= 24 and set(steps[0]) & set(steps[1]) == set()
    again = ViewOrder(centres, seed=3)
    assert [again.take(3) for _ in range(70)] == steps
    assert ViewOrder(centres[:2], seed=0).take(5) == [0, 1]


def test_views_of_a_step_are_far_apart() -> None:
    """Of eight cameras in a circle, four at a time: never two neighbours in the first half of a pass."""
    angle = 2 * np.pi * np.arange(8) / 8
    order = ViewOrder(np.stack([np.cos(angle), np.sin(angle), 0 * angle], -1), seed=5)
    for _ in range(20):
        first, second = order.take(4), order.take(4)
        assert set(np.diff(first)) == {2} and sorted(first + second) == list(range(8))


def test_a_stage_without_a_weight_has_no_term(context: FitContext, initial: InitialGuess) -> None:
    stage = Stage(name="nothing", steps=1, level=1)
    weights = replace(stage.weights, normals=0.0, mask=0.0, classes=0.0, landmarks=0.0, tongue=0.0)
    problem = FitProblem(context, initial)
    created = terms.make_terms(
        StageContext(
            fit=context,
            stage=replace(stage, weights=weights),
            variables=problem.variables,
            appearance=problem.appearance,
            landmarks_used=problem.landmarks_used,
            regularizer=None,
        )
    )
    assert created == ()
