"""The light of views is compared where they show the same: on skin, if labels tell where it is."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from registration.capture.native import read_capture
from registration.capture.samples import ViewSample, sample_views
from registration.doctor.view_checks import exposure_warnings
from registration.types import Capture
from tests.registration.capture import small

SKIN, HAIR = 1, 2  # labels; the ball has no hair, but another class


@pytest.fixture
def ball(tmp_path: Path) -> tuple[Capture, list[ViewSample]]:
    capture = read_capture(small.make(tmp_path / "ball"))
    return capture, sample_views(capture)


def painted(sample: ViewSample, hair: float, light: float = 1.0) -> ViewSample:
    """A view whose subject is dark hair in a share of its rows, and skin below."""
    rows = np.cumsum(sample.subject.sum(1)) / sample.subject.sum()
    labels = np.where(rows < hair, HAIR, SKIN)[:, None] * sample.subject
    grey = light * np.choose(labels, [0.0, 0.4, 0.05])
    return replace(sample, labels=labels.astype(np.uint8), grey=grey)


def test_dark_hair_is_no_other_exposure(ball: tuple[Capture, list[ViewSample]]) -> None:
    """One view shows the face, the others mostly hair: the medians of all pixels differ by three stops."""
    capture, samples = ball
    views = [painted(sample, hair=0.2 if number == 0 else 0.7) for number, sample in enumerate(samples)]
    assert exposure_warnings(capture, views) == []
    unlabelled = [replace(view, labels=None) for view in views]
    assert samples[0].name in exposure_warnings(capture, unlabelled)[0].line


def test_a_view_of_another_exposure_is_found_on_skin(ball: tuple[Capture, list[ViewSample]]) -> None:
    capture, samples = ball
    views = [painted(sample, hair=0.3, light=0.2 if number == 1 else 1.0) for number, sample in enumerate(samples)]
    (found,) = exposure_warnings(capture, views)
    assert samples[1].name in found.line and samples[0].name not in found.line
    from_behind = [painted(samples[0], hair=0.99, light=0.2), *(painted(sample, hair=0.3) for sample in samples[1:])]
    assert exposure_warnings(capture, from_behind) == []  # too little skin to tell
