"""Initial guesses: from landmarks with outliers, and from masks by rated head poses."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from registration.errors import InputError
from registration.fit.initialization import (
    MIN_LANDMARKS,
    PoseCandidate,
    from_landmarks,
    from_masks,
    rate_candidate,
    select_spread_views,
)
from registration.fit.variables import InitialGuess, Variables, pivot
from registration.geometry.rigid import similarity_transform
from registration.model.gnm import GNM
from registration.model.landmarks import LandmarkScheme, read_scheme
from registration.types import Camera, Pixels, Rendered, Targets
from tests.conftest import FIXTURES
from tests.fixtures.make_fixtures import tiny_model

RNG = np.random.default_rng(7)
ROTATION = Rotation.from_rotvec([0.4, -1.9, 0.7]).as_matrix()


@pytest.fixture(scope="module")
def scheme() -> LandmarkScheme:
    return read_scheme(FIXTURES / "head_sparse_68.txt", tiny_model().template_vertex_positions, "68")


def truth(scale: float) -> InitialGuess:
    data = tiny_model()
    return InitialGuess(
        rotation=ROTATION,
        position=np.array([0.3, -0.8, 1.4]),
        scale=scale,
        identity=0.5 * RNG.normal(size=len(data.vertex_identity_basis)),
        expression=0.3 * RNG.normal(size=len(data.expression_basis)),
        offsets=RNG.normal(0, 1e-4, data.template_vertex_positions.shape),
    )


def mesh(guess: InitialGuess) -> np.ndarray:
    variables = Variables(GNM(tiny_model()), tiny_model(), guess)
    return variables.vertices(variables.skin_offsets()).numpy().astype(np.float64)


@pytest.mark.parametrize("scale", [1.0, 1.12])
def test_landmarks_determine_pose_and_shape(scale: float, scheme: LandmarkScheme) -> None:
    expected = mesh(truth(scale))
    guess = from_landmarks(tiny_model(), scheme, scheme.points(expected), free_scale=scale != 1.0)
    assert guess.landmarks_used["68"].all() and guess.notes == ()
    assert scale != 1.0 or guess.scale == 1.0
    distance = np.linalg.norm(scheme.points(mesh(guess)) - scheme.points(expected), axis=1)
    assert distance.max() < 1e-3


def test_outliers_are_excluded_and_named(scheme: LandmarkScheme) -> None:
    expected = mesh(truth(1.0))
    points = scheme.points(expected)
    points[[3, 4, 5, 20]] += [0.0, 0.05, 0.0]
    points[40] = np.nan
    guess = from_landmarks(tiny_model(), scheme, points, free_scale=False)
    assert np.flatnonzero(~guess.landmarks_used["68"]).tolist() == [3, 4, 5, 20, 40]
    assert guess.notes == ("landmarks 3-5, 20 of scheme 68 do not fit the model's: excluded",)
    inliers = guess.landmarks_used["68"]
    distance = np.linalg.norm(scheme.points(mesh(guess)) - scheme.points(expected), axis=1)
    assert distance[inliers].max() < 2e-3


def test_a_neutral_keeps_its_identity_offsets_and_scale(scheme: LandmarkScheme) -> None:
    neutral = truth(1.07)
    expression = replace(neutral, expression=-neutral.expression, position=neutral.position + 0.1)
    guess = from_landmarks(tiny_model(), scheme, scheme.points(mesh(expression)), free_scale=True, neutral=neutral)
    assert guess.identity is neutral.identity and guess.offsets is neutral.offsets and guess.scale == 1.07
    distance = np.linalg.norm(scheme.points(mesh(guess)) - scheme.points(mesh(expression)), axis=1)
    assert distance.max() < 1e-3


def test_few_landmarks_are_never_reduced_further(scheme: LandmarkScheme) -> None:
    points = scheme.points(mesh(truth(1.0)))
    points[MIN_LANDMARKS:] = np.nan
    points[:3] += 0.05 * RNG.normal(size=(3, 3))
    guess = from_landmarks(tiny_model(), scheme, points, free_scale=False)
    assert guess.landmarks_used["68"].sum() == MIN_LANDMARKS


@pytest.mark.parametrize("scale", [1.0, 0.4])
def test_similarity_transforms_are_recovered(scale: float) -> None:
    source, shift = RNG.normal(size=(9, 3)), np.array([3.0, -2.0, 0.5])
    target = scale * source @ ROTATION.T + shift
    estimated_scale, rotation, translation = similarity_transform(source, target, free_scale=scale != 1.0)
    assert estimated_scale == pytest.approx(scale)
    np.testing.assert_allclose(rotation, ROTATION, atol=1e-12)
    np.testing.assert_allclose(translation, shift, atol=1e-12)


def test_mirrored_points_get_a_rotation() -> None:
    source = RNG.normal(size=(9, 3))
    _, rotation, _ = similarity_transform(source, source * [-1, 1, 1], free_scale=True)
    assert np.linalg.det(rotation) == pytest.approx(1.0)


def camera_at(yaw: float, roll: float = 0.0) -> Camera:
    """One metre from the origin, looking at it; upright unless rolled (degrees)."""
    pose = np.eye(4)
    look = Rotation.from_euler("y", yaw, degrees=True).as_matrix() @ np.diag([1.0, -1.0, -1.0])
    pose[:3, :3] = (look @ Rotation.from_euler("z", roll, degrees=True).as_matrix()).T
    pose[:3, 3] = [0, 0, 1]
    intrinsics = np.array([[40.0, 0, 16], [0, 40, 16], [0, 0, 1]])
    return Camera(width_px=32, height_px=32, intrinsics=intrinsics, T_cam_world=pose)


def masks(cameras: list[Camera]) -> Targets:
    """A head in the centre of every image."""
    pixels = Pixels.full(cameras)
    inside = ((pixels.x - 15.5).abs() < 6) & ((pixels.y - 15.5).abs() < 8)
    ones = torch.ones(len(inside))
    return Targets(
        names=tuple(str(k) for k in range(len(cameras))),
        class_names=("skin",),
        pixels=pixels,
        rgb=torch.zeros(len(inside), 3),
        rgb_weight=ones,
        normals=torch.zeros(len(inside), 3),
        normal_weight=torch.zeros(len(inside)),
        mask=inside.float(),
        mask_weight=ones,
        classes=ones[:, None],
        class_weight=ones,
        landmarks={},
        px_per_head=16.0,
    )


def overlap_with(rotation: np.ndarray, asked: list[InitialGuess]):
    """An assessment that falls with the angle from a rotation."""

    def assess(initial: InitialGuess) -> PoseCandidate:
        asked.append(initial)
        angle = Rotation.from_matrix(initial.rotation.T @ rotation).magnitude()
        return PoseCandidate(initial=initial, overlap=1 - angle / 2, score=1 - angle / 2)

    return assess


@pytest.mark.parametrize("roll", [0.0, 90.0])
def test_masks_give_poses_at_their_centre(roll: float) -> None:
    """Upright cameras in front of the subject need 24 poses; rolled ones more."""
    targets = masks([camera_at(yaw, roll) for yaw in (-40, 0, 40)])
    asked: list[InitialGuess] = []
    rotation = Rotation.from_euler("yx", [50, 10], degrees=True).as_matrix()
    guess = from_masks(tiny_model(), targets, overlap_with(rotation, asked), lambda initial: initial)
    assert Rotation.from_matrix(guess.rotation.T @ rotation).magnitude() < np.radians(25)
    np.testing.assert_allclose(guess.position, 0, atol=1e-6)
    assert "no landmarks: best of 24 head poses" in guess.notes[0]
    assert len(asked) == 24 + 5 if roll == 0 else len(asked) > 24 + 5


def test_refinement_selects_among_the_best_poses() -> None:
    targets = masks([camera_at(yaw) for yaw in (-40, 0, 40)])
    rotation = Rotation.from_euler("y", 20, degrees=True).as_matrix()
    guess = from_masks(
        tiny_model(), targets, overlap_with(rotation, []), lambda initial: replace(initial, rotation=rotation)
    )
    assert guess.rotation is rotation


def test_no_pose_that_covers_the_masks_is_an_input_error() -> None:
    targets = masks([camera_at(yaw) for yaw in (-40, 0, 40)])

    def assess(initial: InitialGuess) -> PoseCandidate:
        return PoseCandidate(initial=initial, overlap=0.3, score=0.3)

    with pytest.raises(InputError, match="pose of the head") as refused:
        from_masks(tiny_model(), targets, assess, lambda initial: initial)
    assert "0.30 at best" in refused.value.got


def test_candidates_are_rated_by_masks_normals_and_classes() -> None:
    targets = masks([camera_at(0)])
    guess = InitialGuess(rotation=np.eye(3), position=pivot(tiny_model()))
    exact = Rendered(rgb=targets.rgb, normals=targets.normals, classes=targets.classes, mask=targets.mask)
    assert rate_candidate(guess, exact, targets).overlap == 1.0
    half = replace(exact, mask=targets.mask * (targets.pixels.x < 16))
    assert rate_candidate(guess, half, targets).overlap == pytest.approx(0.5, abs=0.05)
    normals = torch.tensor([0.0, 0.0, 1.0]).expand_as(targets.normals)
    facing = replace(targets, normals=normals, normal_weight=torch.ones(len(normals)))
    same, opposite = replace(exact, normals=normals), replace(exact, normals=-normals)
    assert rate_candidate(guess, same, facing).score == pytest.approx(2.0)
    assert rate_candidate(guess, opposite, facing).score == pytest.approx(0.0)
    assert rate_candidate(guess, exact, replace(targets, mask_weight=torch.zeros(len(normals)))).overlap == 0.0


def test_selected_views_are_far_apart() -> None:
    cameras = [camera_at(yaw) for yaw in (0, 2, 90, 92, 180, 182, 270)]
    assert select_spread_views(cameras, 2) in ([0, 4], [0, 5])
    assert [view // 2 for view in select_spread_views(cameras, 4)] == [0, 1, 2, 3]  # a single view of each close pair
    assert select_spread_views(cameras, 20) == list(range(7)) and select_spread_views(cameras, 1) == [0]


def test_points_weigh_by_their_spread(scheme: LandmarkScheme) -> None:
    """Half of the points are 4 mm off and say so: pose and shape follow the others."""
    expected, rng = mesh(truth(1.0)), np.random.default_rng(1)
    spread = np.where(np.arange(68) % 2, 4e-3, 1e-4)
    exact = scheme.points(expected)
    points = exact + spread[:, None] * rng.standard_normal((68, 3))
    data = tiny_model()
    guesses = [from_landmarks(data, scheme, points, free_scale=False, spread_m=s) for s in (None, spread)]
    plain, weighted = (np.linalg.norm(scheme.points(mesh(guess)) - exact, axis=1).mean() for guess in guesses)
    assert weighted < 0.6 * plain and guesses[1].landmarks_used["68"].all()
