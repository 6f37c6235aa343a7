from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from registration.calibrate.assembly import Evidence, assemble, match_pairs
from registration.calibrate.bundle import Observations, Rig
from registration.calibrate.metric import ModelFit
from registration.calibrate.start import Focals, Start
from registration.geometry.rigid import similarity_transform
from tests.registration.calibrate.rig import FOCAL_PX, POINTS, VIEWS, cloud, observations, perturbed, rig

LANDMARKS, FACES = 40, slice(2, 6)  # views 2 to 5 show the face


def scene(seed: int, *, outliers: float = 0.03) -> tuple[Rig, np.ndarray, Evidence, Start]:
    """Landmarks of 3 px noise in four views, tracks of 0.3 px in all eight."""
    generator = np.random.default_rng(seed)
    truth, points = rig(generator), cloud(generator)
    marks = points[:LANDMARKS]
    seen = observations(truth, marks, generator, noise_px=3.0)
    tracks = observations(truth, points, generator, noise_px=0.3, outliers=outliers)
    posed = np.zeros(VIEWS, bool)
    posed[FACES] = True
    evidence = Evidence(
        landmarks=seen.where(posed[seen.view]),
        tracks=replace(tracks, sigma_px=np.ones(len(tracks))),
        track_count=POINTS,
        side_px=np.full(VIEWS, 720.0),
    )
    start = perturbed(truth, generator, 1.1)
    lost = np.where(posed[:, None, None], start.rotations, np.eye(3))
    start = replace(start, rotations=lost, translations=start.translations * posed[:, None])
    return truth, points, evidence, Start(rig=start, posed=posed, points=marks, wrong=())


def fit_to(marks: np.ndarray) -> Callable[[np.ndarray], ModelFit]:
    """The head model's part: a similarity transform to known landmarks."""

    def fit(points: np.ndarray) -> ModelFit:
        used = np.isfinite(points).all(1)
        scale, rotation, shift = similarity_transform(points[used], marks[used], free_scale=True)
        distance = np.linalg.norm(scale * points @ rotation.T + shift - marks, axis=1)
        return ModelFit(
            scale=scale, rotation=rotation, shift=shift, landmarks=marks, distance_m=distance, scale_sigma=0.01
        )

    return fit


def unknown() -> Focals:
    return Focals(px=np.array([np.nan]), sigma=np.array([np.inf]), side_px=np.array([720.0]), deviation_sigma=0.0)


@pytest.mark.parametrize("seed", [0, 1])
def test_views_without_a_face_are_posed_by_their_tracks(seed: int) -> None:
    truth, points, evidence, start = scene(seed)
    lines: list[str] = []
    result = assemble(start, evidence, unknown(), fit_to(points[:LANDMARKS]), None, report=lines.append)
    assert result.posed.all() and "8 of 8 views posed" in lines[-1]
    found = result.adjusted
    assert abs(found.rig.focals_px[0] - FOCAL_PX) < max(4 * found.focal_sigma_px[0], 15)
    scale, rotation, shift = similarity_transform(found.points[LANDMARKS:], points, free_scale=True)
    assert scale == pytest.approx(1.0, abs=0.02)
    np.testing.assert_allclose(found.rig.moved(scale, rotation, shift).positions, truth.positions, atol=0.02)
    tracks = ~result.of_landmarks
    assert np.sqrt(np.mean(found.residuals_px[tracks] ** 2)) == pytest.approx(0.3, abs=0.1)


def test_a_view_without_tracks_stays_out() -> None:
    _, points, evidence, start = scene(2)
    tracks = evidence.tracks.where(evidence.tracks.view != 7)
    result = assemble(start, replace(evidence, tracks=tracks), unknown(), fit_to(points[:LANDMARKS]), None)
    assert result.posed.tolist() == [True] * 7 + [False]


def test_landmarks_alone_pose_the_views_that_show_them() -> None:
    truth, points, evidence, start = scene(3)
    none = Observations(
        view=np.zeros(0, np.int64), point=np.zeros(0, np.int64), xy_px=np.zeros((0, 2)), sigma_px=np.zeros(0)
    )
    known = Focals(px=np.array([FOCAL_PX]), sigma=np.zeros(1), side_px=np.array([720.0]), deviation_sigma=0.0)
    start = replace(start, rig=replace(start.rig, focals_px=known.px))
    result = assemble(start, replace(evidence, tracks=none, track_count=0), known, fit_to(points[:LANDMARKS]), None)
    assert np.flatnonzero(result.posed).tolist() == [2, 3, 4, 5]
    assert result.adjusted.rig.focals_px[0] == FOCAL_PX
    np.testing.assert_allclose(result.adjusted.rig.positions[FACES], truth.positions[FACES], atol=0.03)


def test_views_from_different_sides_are_not_matched() -> None:
    _, _, _, start = scene(0)
    pairs = match_pairs(start, np.radians(30.0))
    assert (2, 3) in pairs and (2, 5) not in pairs  # 20 and 59 degrees
    assert (0, 7) in pairs and (0, 2) in pairs  # of views without a pose nothing is known
