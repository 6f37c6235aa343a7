"""Which views of a capture a fit suspects: those at fault, not those that show what the mesh has wrong."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import pytest
from jaxtyping import Int

from registration.fit.context import FitContext
from registration.fit.initialization import from_landmarks
from registration.fit.problem import FitProblem
from registration.fit.recipes import preview
from registration.fit.variables import InitialGuess
from registration.fit.view_weights import HEAD_PX, ViewWeights
from registration.inputs import RegistrationInputs, read_inputs
from registration.model.atlas import texture_atlas
from registration.model.gnm import GNM
from registration.model.landmarks import LandmarkScheme
from registration.options import RegisterOptions
from registration.render import backend
from registration.targets.classes import class_map
from registration.targets.pyramid import build_pyramid
from tests.registration.register import synthetic


def defined_elsewhere(context: FitContext, members: Int[np.ndarray, "K"]) -> LandmarkScheme:
    """The scheme with some landmarks on the vertex that lies closest to 12 mm from where the capture has them."""
    scheme, vertices = context.schemes["68"], context.data.template_vertex_positions
    indices, weights = scheme.indices.copy(), scheme.weights.copy()
    for landmark, point in zip(members, scheme.points(vertices)[members], strict=True):
        indices[landmark] = np.abs(np.linalg.norm(vertices - point, axis=1) - 0.012).argmin()
        weights[landmark] = 1, 0, 0
    return replace(scheme, indices=indices, weights=weights)


@pytest.fixture(scope="module")
def inputs(tmp_path_factory: pytest.TempPathFactory) -> RegistrationInputs:
    truth = synthetic.make(tmp_path_factory.mktemp("trust") / "neutral")
    return read_inputs(truth.root, synthetic.MODEL, RegisterOptions(recipe=preview()))


@pytest.fixture(scope="module")
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
        triangulated=inputs.landmarks,
    )


@pytest.fixture(scope="module")
def initial(inputs: RegistrationInputs) -> InitialGuess:
    return from_landmarks(inputs.data, inputs.schemes["68"], inputs.landmarks["68"], free_scale=True)


def suspected(context: FitContext, initial: InitialGuess) -> Mapping[str, str]:
    """The views that a fit would trust less at its start, and why."""
    return ViewWeights.from_errors(FitProblem(context, initial).view_errors()).notes


def test_a_view_that_sees_what_the_mesh_has_wrong_is_not_suspected(context: FitContext, initial: InitialGuess) -> None:
    """The side view sees few landmarks; the mesh has most of these 12 mm off, and few of the other views' ones."""
    names, seen = context.pyramid[0].names, context.pyramid[0].landmarks["68"][..., 2].numpy() > 0.5
    view = int(seen.sum(1).argmin())
    wrong = np.flatnonzero(seen[view])[: seen[view].sum() * 2 // 3]
    other = replace(context, schemes={"68": defined_elsewhere(context, wrong)})
    assert names[view] in suspected(replace(other, triangulated={}), initial)  # what the mesh alone would say
    assert suspected(other, initial) == {}


@pytest.mark.parametrize("view", [0, 3])
def test_a_view_whose_landmarks_are_shifted_is_suspected(context: FitContext, initial: InitialGuess, view: int) -> None:
    finest = context.pyramid[0]
    landmarks = finest.landmarks["68"].clone()
    landmarks[view, :, 0] += 30 * finest.px_per_head / HEAD_PX
    pyramid = (replace(finest, landmarks={"68": landmarks}), *context.pyramid[1:])
    notes = suspected(replace(context, pyramid=pyramid), initial)
    assert list(notes) == [finest.names[view]] and "landmarks" in notes[finest.names[view]]
