import numpy as np
import pytest

from registration.errors import InputError
from registration.stereo.first_pass import first_depths
from registration.stereo.pairs import choose_partners
from registration.stereo.rectify import homography, rectify
from registration.stereo.views import head_image
from tests.registration.stereo.scene import CENTRE, RADIUS, camera, errors, scene


def test_partners_are_ten_to_thirty_degrees_away_and_on_both_sides():
    cameras = [camera(yaw) for yaw in (-90, -60, -40, -20, -4, 0, 20, 40, 180)]
    partners = choose_partners(cameras, CENTRE)
    assert set(partners[5][:2]) == {3, 6}  # both sides, neither the next one nor the rear
    assert 8 not in {k for found in partners for k in found}
    assert partners[8] == ()


def test_two_views_take_what_there_is():
    assert choose_partners([camera(0), camera(48)], CENTRE) == ((1,), (0,))


@pytest.mark.parametrize("yaws", [(0,), (0, 95), (0, 1)])
def test_views_without_a_partner_are_refused_with_their_angles(yaws):
    with pytest.raises(InputError) as refused:
        choose_partners([camera(yaw) for yaw in yaws], CENTRE)
    assert "1" in refused.value.got if len(yaws) == 1 else f"{yaws[1]} to {yaws[1]} degrees" in refused.value.got


@pytest.mark.parametrize("turned", [False, True])
def test_rectified_rows_correspond_and_disparities_give_depths(turned):
    first, second = camera(10, 8), camera(-13, -4)
    pair, forward = rectify(*((second, first) if turned else (first, second)), CENTRE, RADIUS, 300)
    points = CENTRE + np.random.default_rng(0).normal(size=(20, 3)) * 0.03
    left, depth = pair.left.project(points)
    right = pair.right.project(points)[0]
    np.testing.assert_allclose(left[:, 1], right[:, 1], atol=1e-9)
    np.testing.assert_allclose(pair.depth_of(left[:, 0] - right[:, 0]), depth)
    np.testing.assert_allclose(pair.disparity_of(depth), left[:, 0] - right[:, 0], atol=1e-9)
    for one in (pair.left, pair.right):  # the head's centre is the middle of both
        np.testing.assert_allclose(one.project(CENTRE[None])[0][0], [one.width_px / 2, one.height_px / 2])
    source = (second if turned else first) if forward else (first if turned else second)
    np.testing.assert_allclose(pair.left.centre, source.centre)
    pixels, _ = source.project(points)
    mapped = np.c_[pixels - 0.5, np.ones(20)] @ homography(source, pair.left).T
    np.testing.assert_allclose(mapped[:, :2] / mapped[:, 2:] + 0.5, left, atol=1e-8)


def test_first_pass_finds_the_surface():
    made = scene((-22, 0, 22))
    maps = first_depths(made.views, CENTRE, RADIUS)
    found = [errors(one, view.camera, seen) for one, view, seen in zip(maps, made.views, made.truth, strict=True)]
    assert found[1][0] > 0.6
    assert all(coverage > 0.5 for coverage, _, _ in found)
    assert max(np.median(wrong) for _, wrong, _ in found) < 0.4  # a pixel is 1.4 mm wide
    assert max(np.median(angle) for _, _, angle in found) < 6
    assert all(((one.depth > 0) == (one.confidence > 0)).all() for one in maps)


def test_two_views_alone_give_depths():
    made = scene((0, 24))
    maps = first_depths(made.views, CENTRE, RADIUS)
    coverage, wrong, _ = errors(maps[0], made.views[0].camera, made.truth[0])
    assert coverage > 0.5
    assert np.median(wrong) < 0.6


def test_pictures_without_texture_give_no_depths():
    made = scene((-22, 0, 22), contrast=0.0)
    maps = first_depths(made.views, CENTRE, RADIUS)
    coverage, _, _ = errors(maps[1], made.views[1].camera, made.truth[1])
    assert coverage < 0.1


def test_a_view_that_does_not_show_the_head_has_no_window():
    made = scene((0,))
    assert head_image(made.views[0], CENTRE + 1.0, RADIUS) is None
