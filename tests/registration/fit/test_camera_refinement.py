"""The correction of cameras as part of a fit, on a small synthetic capture with wrong cameras."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from jaxtyping import Float

from bench.support.cameras import rig_errors_px
from registration.capture.triangulation import triangulate
from registration.degrading.degradation import perturbed_camera
from registration.fit.context import FitContext
from registration.fit.initialization import from_landmarks
from registration.fit.problem import FitProblem
from registration.fit.recipes import preview
from registration.inputs import RegistrationInputs, read_inputs
from registration.model.atlas import texture_atlas
from registration.model.gnm import GNM
from registration.options import RegisterOptions
from registration.render import backend
from registration.targets.classes import class_map
from registration.targets.pyramid import build_pyramid
from registration.types import Camera, Capture
from tests.registration.register import synthetic

RMS_PX = 1.0


@pytest.fixture(scope="module")
def truth(tmp_path_factory: pytest.TempPathFactory) -> synthetic.Truth:
    return synthetic.make(tmp_path_factory.mktemp("refinement") / "neutral")


@pytest.fixture(scope="module")
def inputs(truth: synthetic.Truth) -> RegistrationInputs:
    recipe = preview()
    stages = tuple(replace(stage, steps=min(stage.steps, 16)) for stage in recipe.stages)
    return read_inputs(truth.root, synthetic.MODEL, RegisterOptions(recipe=replace(recipe, stages=stages)))


def wrong_cameras(inputs: RegistrationInputs, points: Float[np.ndarray, "V 3"]) -> Capture:
    views = [
        replace(view, camera=perturbed_camera(view.camera, points, RMS_PX, np.random.default_rng(number)))
        for number, view in enumerate(inputs.capture.views)
    ]
    return replace(inputs.capture, views=tuple(views))


def fitted(inputs: RegistrationInputs, capture: Capture, sigma_px: float) -> FitProblem:
    """A fit of a capture in place of the inputs' one."""
    device, classes = backend.activate("llvm"), class_map(capture.classes)
    landmarks = {"68": triangulate(capture, "68")[0]}
    context = FitContext(
        data=inputs.data,
        model=GNM(inputs.data, device=device),
        pyramid=build_pyramid(capture, classes, finest_head_px=128, levels=2),
        classes=classes,
        schemes=inputs.schemes,
        corner_uvs=texture_atlas(inputs.data),
        recipe=inputs.recipe,
        seed=0,
        triangulated=landmarks,
        camera_sigma_px=np.full(len(capture.views), sigma_px) if sigma_px else None,
    )
    initial = from_landmarks(inputs.data, inputs.schemes["68"], landmarks["68"], free_scale=True)
    problem = FitProblem(context, initial)
    assert problem.run(inputs.recipe.stages).failure is None
    return problem


def errors_px(cameras: Sequence[Camera], true: Sequence[Camera], points: Float[np.ndarray, "V 3"]) -> float:
    """The rms error of cameras, px, but for a similarity of the world that they share."""
    return float(np.sqrt(np.square(rig_errors_px(cameras, true, points)).mean()))


@pytest.mark.slow
def test_a_fit_finds_the_errors_of_cameras(inputs: RegistrationInputs, truth: synthetic.Truth) -> None:
    points = truth.vertices.astype(np.float64)
    capture = wrong_cameras(inputs, points)
    problem = fitted(inputs, capture, RMS_PX)
    assert problem.refinement is not None
    corrected = problem.refinement.corrected(capture)
    true, before, after = (
        [view.camera for view in views] for views in (inputs.capture.views, capture.views, corrected.views)
    )
    left_px = errors_px(before, true, points), errors_px(after, true, points)
    assert left_px[0] > 0.6 and left_px[1] < 0.3 * left_px[0]
    used = problem.pyramid[0].pixels.cameras
    for camera, mine in zip(after, used, strict=True):
        np.testing.assert_allclose(camera.T_cam_world, mine.T_cam_world)
    figures = problem.refinement.figures(capture, RMS_PX)
    shifts = [row["shift_px"] for row in figures["views"].values()]
    assert len(shifts) == len(capture.views) and 0.3 < np.mean(shifts) < 1.6
    assert figures["warnings"] == []


@pytest.mark.slow
def test_exact_cameras_stay(inputs: RegistrationInputs, truth: synthetic.Truth) -> None:
    points = truth.vertices.astype(np.float64)
    problem = fitted(inputs, inputs.capture, RMS_PX)
    given = problem.context.pyramid[0].pixels.cameras
    assert errors_px(problem.pyramid[0].pixels.cameras, given, points) < 0.15


@pytest.mark.slow
def test_a_moved_camera_is_named(inputs: RegistrationInputs, truth: synthetic.Truth) -> None:
    """One camera is off by four times what is stated: corrected, and named."""
    points, views = truth.vertices.astype(np.float64), list(inputs.capture.views)
    moved = perturbed_camera(views[3].camera, points, 2.0, np.random.default_rng(5))
    views[3] = replace(views[3], camera=moved)
    problem = fitted(inputs, replace(inputs.capture, views=tuple(views)), 0.4)
    assert problem.refinement is not None
    (warning,) = problem.refinement.warnings()
    assert views[3].name in warning
