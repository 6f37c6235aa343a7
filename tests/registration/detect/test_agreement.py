from dataclasses import replace

import numpy as np
import pytest

from registration.detect.agreement import agree, relative_residual
from tests.registration.detect.known import NOISE, cameras, face, head, view


def test_all_views_of_one_head_agree() -> None:
    views = [view(k, cam, face(cam, head(), k)) for k, cam in enumerate(cameras())]
    found = agree(views)
    assert found is not None and found.count == 5 and (found.used >= 4).all()
    assert np.abs(found.points - head()).max() < 0.004
    for each in views:
        assert relative_residual(each.camera, each.faces[0], found.points) < 2 * NOISE


def test_a_wrong_point_costs_one_observation() -> None:
    views = [view(k, cam, face(cam, head(), k)) for k, cam in enumerate(cameras())]
    moved = views[2].faces[0].points.copy()
    moved[7] += 40
    views[2] = replace(views[2], faces=(replace(views[2].faces[0], points=moved),))
    found = agree(views)
    assert found is not None and found.count == 5 and found.used[7] == 4
    assert np.abs(found.points[7] - head()[7]).max() < 0.004


def test_the_person_whom_most_views_see_is_taken() -> None:
    """Another person stands beside in three views, and comes first there."""
    other = head(1) + [0.16, 0.02, -0.05]
    views = []
    for k, cam in enumerate(cameras()):
        faces = [face(cam, other, k)] if k < 3 else []
        views.append(view(k, cam, *faces, face(cam, head(), k + 10)))
    found = agree(views)
    assert found is not None and found.chosen == (1, 1, 1, 0, 0)


def test_a_view_of_another_place_is_left_out() -> None:
    views = [view(k, cam, face(cam, head(), k)) for k, cam in enumerate(cameras())]
    views[1] = view(1, views[1].camera, face(views[1].camera, head() + [0.0, 0.03, 0.0], 1))
    found = agree(views)
    assert found is not None and found.chosen == (0, None, 0, 0, 0)


def test_a_false_face_at_profile_is_left_out() -> None:
    """The detector claims a frontal face where the camera sees a profile."""
    profile = cameras((1.3,))[0]
    false = face(cameras((0.5,))[0], head(), 3)
    shift = profile.project(head())[0].mean(0) - false.points.mean(0)
    false = replace(false, points=false.points + shift)
    views = [view(k, cam, face(cam, head(), k)) for k, cam in enumerate(cameras())]
    found = agree([*views, view(5, profile, false)])
    assert found is not None and found.chosen == (0, 0, 0, 0, 0, None)


def test_hidden_points_do_not_count() -> None:
    """Half of a view's points are wrong but said to be hidden."""
    views = [view(k, cam, face(cam, head(), k)) for k, cam in enumerate(cameras())]
    first = views[0].faces[0]
    points, confidence = first.points.copy(), first.confidence.copy()
    points[::2] += 30
    confidence[::2] = 0.2
    views[0] = replace(views[0], faces=(replace(first, points=points, confidence=confidence),))
    found = agree(views)
    assert found is not None and found.count == 5 and found.used[0] == 4 and found.used[1] == 5


@pytest.mark.parametrize("yaws", [(0.0, 0.3), (0.0,)])
def test_nothing_agrees(yaws: tuple[float, ...]) -> None:
    """Two views of places far from each other, or one view."""
    views = [view(k, cam, face(cam, head() + [0, 0.05 * k, 0], k)) for k, cam in enumerate(cameras(yaws))]
    assert agree(views) is None
    assert agree([]) is None and agree([view(0, cameras()[0])]) is None
