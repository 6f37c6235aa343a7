from dataclasses import replace

import numpy as np

from registration.detect.agreement import agree
from registration.detect.judgement import inside_out, judge, named, turned_away_deg
from tests.registration.detect.known import cameras, face, head, view


def test_outcomes() -> None:
    cams = cameras()
    good = [view(k, cam, face(cam, head(), k)) for k, cam in enumerate(cams)]
    assert judge(good, agree(good), {}, "other")[0] == "found"
    empty = [view(k, cam) for k, cam in enumerate(cams)]
    assert judge(empty, None, {}, "other") == ("no face", "no face in any of 5 views")
    assert judge([good[0], *empty[1:]], None, {}, "other") == ("one view", "a face in cam0 alone")
    apart = [view(k, cam, face(cam, head() + [0, 0.05 * k, 0], k)) for k, cam in enumerate(cams)]
    outcome, reason = judge(apart, agree(apart), {}, "other")
    assert outcome == "contradictory" and "cam0" in reason
    two_of_five = [*good[:2], *apart[2:]]
    outcome, reason = judge(two_of_five, agree(two_of_five), {}, "other")
    assert outcome == "contradictory" and "2 of 5" in reason and "cam4" in reason


def test_cameras_that_look_apart() -> None:
    """Their rays meet behind one of them."""
    cams = cameras((0.0, 0.4))
    first = view(0, cams[0], face(cams[0], head() - [0.05, 0, 0]))
    second = view(1, cams[1], face(cams[1], head() - [0.05, 0, 0]))
    turned = cams[1].T_cam_world.copy()
    turned[:3, :3] = np.diag([-1.0, 1, -1]) @ turned[:3, :3]  # it looks the other way
    turned[:3, 3] = -turned[:3, :3] @ cams[1].centre
    second = replace(second, camera=replace(cams[1], T_cam_world=turned))
    outcome, reason = judge([first, second], agree([first, second]), {}, "other")
    assert outcome == "contradictory" and "look at different places" in reason


def test_a_face_inside_out() -> None:
    points = np.zeros((68, 3))  # y up, z to the camera, the subject's right at -x
    points[[36, 39, 48], 0], points[[42, 45, 54], 0] = -0.03, 0.03
    points[[19, 24], 1], points[[7, 8, 9], 1] = 0.03, -0.07
    points[[29, 30, 33], 2] = 0.03
    assert not inside_out(points, "68")
    assert inside_out(points * [1, 1, -1], "68") and inside_out(points * [-1, 1, 1], "68")
    assert not inside_out(points * [1, 1, -1], "unknown") and not inside_out(points * np.nan, "68")


def test_the_turn_away_from_a_camera() -> None:
    cams = cameras((-0.3, 0.0, 0.3))
    views = [view(k, cam, face(cam, head(), k)) for k, cam in enumerate(cams)]
    agreement = agree(views)
    assert agreement is not None
    side, front = (turned_away_deg(views, agreement, cam) for cam in cameras((1.5, 0.0)))
    assert front < 15 and 70 < side < 100


def test_names_are_shortened() -> None:
    assert named(["a", "b"]) == "a, b" and named(list("abcdefgh")) == "a, b, c, d, e, f and 2 more"
