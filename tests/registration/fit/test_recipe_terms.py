"""What the named recipes compare while offsets are free: a term that is dropped from the fit is missed here."""

from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np
import pytest
import torch

from registration.fit import problem as problem_module
from registration.fit.context import FitContext
from registration.fit.initialization import from_landmarks
from registration.fit.problem import FitProblem
from registration.fit.recipes import Recipe, draft, studio
from registration.fit.terms import StageContext, StepState, Term, make_terms
from registration.inputs import RegistrationInputs, read_inputs
from registration.losses.self_intersection import OF_THE_TONGUE
from registration.model.atlas import texture_atlas
from registration.model.gnm import GNM
from registration.options import RegisterOptions
from registration.render import backend
from registration.targets.classes import class_map
from registration.targets.pyramid import build_pyramid
from registration.types import Registration
from tests.registration.register import synthetic


@pytest.fixture(scope="module")
def inputs(tmp_path_factory: pytest.TempPathFactory) -> RegistrationInputs:
    truth = synthetic.make(tmp_path_factory.mktemp("terms") / "neutral")
    return read_inputs(truth.root, synthetic.MODEL, RegisterOptions(recipe="draft", views=3))


def neutral(inputs: RegistrationInputs) -> Registration:
    """Of the template's shape, with a texture of stripes."""
    vertices = np.asarray(inputs.data.template_vertex_positions, np.float32)
    rows = np.linspace(0, 40, 256, dtype=np.float32)[:, None, None]
    return Registration(
        status="converged",
        reason="",
        identity=np.zeros(1, np.float32),
        expression=np.zeros(1, np.float32),
        rotations=np.zeros((1, 3), np.float32),
        translation=np.zeros(3, np.float32),
        scale=np.ones((), np.float32),
        offsets=np.zeros_like(vertices),
        vertices=vertices,
        triangles=inputs.data.triangles,
        confidence=np.ones(len(vertices), np.float32),
        texture=np.broadcast_to(0.4 + 0.2 * np.sin(rows), (256, 256, 3)).astype(np.float32),
        corner_uvs=texture_atlas(inputs.data),
    )


@pytest.mark.parametrize("recipe", (draft, studio))
def test_named_recipes_compare_everything(
    inputs: RegistrationInputs, recipe: Callable[[], Recipe], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The SSIM of colours and that of the neutral's texture move the skin; contacts are tested for every pair."""
    device, classes = backend.activate("llvm"), class_map(inputs.capture.classes)
    context = FitContext(
        data=inputs.data,
        model=GNM(inputs.data, device=device),
        pyramid=build_pyramid(inputs.capture, classes, finest_head_px=128, levels=1),
        classes=classes,
        schemes=inputs.schemes,
        corner_uvs=texture_atlas(inputs.data),
        recipe=recipe(),
        seed=0,
        neutral=neutral(inputs),
    )
    guess = from_landmarks(inputs.data, inputs.schemes["68"], inputs.landmarks["68"], free_scale=True)
    moved: dict[str, dict[str, float]] = {}

    def recorded(of: StageContext) -> tuple[Term, ...]:
        """The terms of a stage; each tells by how much its losses move the skin."""

        def record(term: Term) -> Term:
            def call(state: StepState) -> Mapping[str, torch.Tensor]:
                losses = term(state)
                for name, loss in losses.items():
                    (slope,) = torch.autograd.grad(loss, state.skin_offsets, retain_graph=True, allow_unused=True)
                    moved.setdefault(of.stage.name, {})[name] = 0.0 if slope is None else float(slope.abs().max())
                return losses

            return call

        return tuple(record(term) for term in make_terms(of))

    monkeypatch.setattr(problem_module, "make_terms", recorded)
    stages = [
        replace(stage, steps=1, level=0, weights=replace(stage.weights, ssim=0.06 * number))
        for number, stage in enumerate(filter(lambda stage: stage.frees("offsets"), recipe().stages))
    ]
    assert FitProblem(context, guess).run(stages).failure is None
    without_ssim, *with_ssim = moved.values()
    for losses in (without_ssim, *with_ssim):
        assert min(losses[name] for name in ("normals", "mask", "classes", "rgb", "slide")) > 0
        pairs = {name.removeprefix("contact ") for name in losses if name.startswith("contact ")}
        assert pairs == set(context.self_intersection.pairs) and set(OF_THE_TONGUE) <= pairs
    assert all(losses["ssim"] > 0 for losses in with_ssim) and "ssim" not in without_ssim
