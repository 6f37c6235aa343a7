from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from registration.fit.initialization import from_landmarks
from registration.fit.landmark_start import refined, seen_landmarks
from registration.fit.variables import Variables
from registration.inputs import read_inputs
from registration.model.gnm import GNM
from registration.options import RegisterOptions
from registration.types import Camera, Capture, View
from tests.registration.landmark_fit.scenes import Scene, scheme, tiny

SHARED = Path(__file__).parents[4] / "shared" / "data"


def _vertices(data, guess):
    variables = Variables(GNM(data), data, guess)
    with torch.no_grad():
        return variables.vertices(variables.skin_offsets()).double().numpy()


def _capture(scene: Scene, views: int) -> Capture:
    pixels = scene.observations().points_px[0]
    made = []
    for v, known in enumerate(scene.views[:views]):
        K = np.array([[known.focal_px, 0, 256], [0, known.focal_px, 256], [0, 0, 1.0]])
        camera = Camera(width_px=512, height_px=512, intrinsics=K, T_cam_world=known.T_cam_world)
        rows = np.column_stack([pixels[v], np.ones(len(pixels[v]))])
        made.append(View(name=f"cam{v}", camera=camera, image=Path(f"cam{v}.png"), landmarks={"points": rows}))
    return Capture(root=Path(), subject="s", expression="neutral", views=tuple(made))


@pytest.mark.parametrize("views", [1, 3])
def test_landmarks_of_the_views_give_the_head(views):
    data = tiny()
    scene = Scene(data, scheme(data, 300), views=3)
    capture = _capture(scene, views)
    landmarks = seen_landmarks(capture, {"points": scene.scheme})
    guess = refined(data, landmarks, None, neutral=None, size=False)
    assert guess is not None
    fitted = _vertices(data, guess)
    projected, _ = capture.views[0].camera.project(scene.scheme.points(fitted))
    distance = np.linalg.norm(projected - scene.observations().points_px[0, 0], axis=1)
    assert np.median(distance) < 1.0
    if views == 3:
        assert np.linalg.norm(fitted - scene.vertices[0], axis=1).mean() < 1e-3


def test_the_neutral_keeps_identity_offsets_and_size():
    data = tiny()
    scene = Scene(data, scheme(data, 300), views=3)
    landmarks = seen_landmarks(_capture(scene, 3), {"points": scene.scheme})
    neutral = refined(data, landmarks, None, neutral=None, size=False)
    neutral = replace(neutral, offsets=np.full((len(data.template_vertex_positions), 3), 1e-3), scale=1.02)
    guess = refined(data, landmarks, replace(neutral, expression=None), neutral=neutral, size=True)
    np.testing.assert_array_equal(guess.identity, neutral.identity)
    np.testing.assert_array_equal(guess.offsets, neutral.offsets)
    assert guess.scale == pytest.approx(1.02)


def test_few_landmarks_are_not_enough():
    data = tiny()
    scene = Scene(data, scheme(data, 12), views=1)
    assert seen_landmarks(_capture(scene, 1), {"points": scene.scheme}) is None
    assert seen_landmarks(_capture(scene, 1), {}) is None


@pytest.mark.parametrize("name", ["gnm_identity_a/neutral", "gnm_identity_a/happy"])
def test_the_start_of_a_real_capture_is_nearer_than_the_closed_form(name):
    model = SHARED / "gnm" / "gnm_head_reconstructed.npz"
    if not model.exists():
        pytest.skip(f"needs {model}")
    inputs = read_inputs(SHARED / "captures" / name, model, RegisterOptions())
    scheme_68, points = inputs.schemes["68"], inputs.landmarks["68"] - inputs.origin
    closed = from_landmarks(inputs.data, scheme_68, points, free_scale=False)
    landmarks = seen_landmarks(inputs.capture.cameras_relative_to(inputs.origin), {"68": scheme_68})
    guess = refined(inputs.data, landmarks, closed, neutral=None, size=False)
    truth = np.load(SHARED / "captures" / name / "ground_truth.npz")["vertices"] - inputs.origin
    before, after = (np.linalg.norm(_vertices(inputs.data, g) - truth, axis=1).mean() for g in (closed, guess))
    assert after < before
