"""Levels of small images: none is reduced below the height of a head that a recipe asks for at least."""

import pytest

from registration.targets.classes import class_map
from registration.targets.pyramid import build_pyramid
from tests.registration.targets.test_pyramid import CLASSES, assert_channels_match_cameras, capture, pyramid

__all__ = ["capture", "pyramid"]  # fixtures


def test_no_level_is_reduced_below_the_coarsest_head(capture, pyramid):
    levels = build_pyramid(capture, class_map(CLASSES), finest_head_px=10_000, levels=4, coarsest_head_px=60)
    assert (
        len(levels[0].pixels.view) == len(pyramid[0].pixels.view) and levels[2] is levels[1] and levels[3] is levels[1]
    )
    assert levels[1].px_per_head == pytest.approx(levels[0].px_per_head * 60 / 87, rel=0.02)
    assert_channels_match_cameras(levels[1], least=2000 * (60 / 87) ** 2)
    small = build_pyramid(capture, class_map(CLASSES), finest_head_px=10_000, levels=2, coarsest_head_px=128)
    assert small[1] is small[0]
