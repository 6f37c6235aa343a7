from dataclasses import replace

import numpy as np
import pytest

from coregister.anatomy.tongue import TongueSettings, TongueSources, tongue_basis
from coregister.anatomy.tongue_mouth import JawOpening, Mouth
from coregister.anatomy.tongue_poses import PoseSettings, draw_poses, model_expressions
from coregister.anatomy.tongue_rig import TongueRig
from registration.anatomy.tongue_structure import find_tongue
from registration.errors import InputError
from registration.model import gnm_npz, regions
from tests.conftest import SHARED, needs_shared

GNM = SHARED / "data" / "gnm" / "gnm_head_reconstructed.npz"
SETTINGS = TongueSettings(samples=40, poses=PoseSettings(mouths=1))


@pytest.fixture(scope="module")
def gnm():
    return gnm_npz.read(GNM)


@needs_shared
def test_the_jaw_opens_by_the_gap_and_carries_the_tongue(gnm):
    jaw = JawOpening.of(gnm)
    moved = jaw.displacement(jaw.coefficients(0.02, np.random.default_rng(0), 0.5))
    points = gnm.template_vertex_positions
    teeth = regions.teeth(gnm) & regions.lower_teeth(gnm)
    front = teeth & (points[:, 2] > points[teeth, 2].max() - 6e-3) & (np.abs(points[:, 0]) < 8e-3)
    assert moved[front, 1].mean() == pytest.approx(-0.02, abs=1e-6)
    assert moved[regions.tongue(gnm), 1].mean() < -5e-3


@needs_shared
def test_a_tongue_in_the_lower_teeth_is_as_deep_as_it_was_pushed(gnm):
    template = gnm.template_vertex_positions.astype(np.float64)
    jaw = JawOpening.of(gnm)
    mouth = Mouth(gnm, template + jaw.displacement(jaw.coefficients(0.03)))
    assert max(mouth.excess_mm(mouth.carried).values()) == 0
    lifted = mouth.carried + (0, 6e-3, 0)
    assert mouth.excess_mm(lifted, skin=False)["teeth and gums"] == 0
    depths = [mouth.excess_mm(mouth.carried + (x, 0, 0))["teeth and gums"] for x in (1e-3, 3e-3, 5e-3)]
    assert 0 < depths[0] < depths[1] < depths[2]
    assert mouth.excess_mm(mouth.carried + (0, 0.045, 0))["teeth and gums"] > 1  # in the palate


@needs_shared
def test_drawn_poses_fit_their_mouths(gnm):
    rig, rng = TongueRig(structure=find_tongue(gnm)), np.random.default_rng(1)
    settings = PoseSettings(mouths=1)
    expression = next(model_expressions(gnm, settings, rng))
    poses = draw_poses(rig, gnm, [expression], 8, settings, rng)
    mouth = Mouth(gnm, gnm.template_vertex_positions + expression)
    for displacement in poses.displacements:
        assert max(mouth.excess_mm(mouth.carried + displacement).values()) <= settings.penetration_mm
        assert abs(rig.volume_ratio(rig.structure.rest + displacement) - 1) <= settings.volume_change


@needs_shared
def test_the_basis_is_symmetric_deterministic_and_starts_with_its_mean(gnm):
    basis = tongue_basis(gnm, SETTINGS)
    assert basis.names[:2] == ("tongue_mean", "tongue_000") and basis.template is None
    assert np.array_equal(basis.vertices, np.flatnonzero(regions.tongue(gnm)))
    rig = find_tongue(gnm)
    mean = basis.components[0]
    assert np.abs(mean[rig.mirror] * (-1, 1, 1) - mean).max() < 1e-7
    assert np.abs(basis.components[:, rig.attached]).max() < 1e-9
    # Scaled by standard deviations: their squares sum to the variance kept.
    kept = (basis.components[1:] ** 2).sum() / len(mean)
    assert kept == pytest.approx((basis.record["rms_mm"] * 1e-3) ** 2 * basis.record["variance_kept"], rel=1e-4)
    assert basis.record["variance_kept"] >= SETTINGS.variance_ratio
    assert np.array_equal(tongue_basis(gnm, SETTINGS).components, basis.components)


@needs_shared
def test_too_few_samples_are_refused(gnm):
    with pytest.raises(InputError, match="too few samples"):
        tongue_basis(gnm, TongueSettings(samples=20))


@needs_shared
def test_open_mouths_of_registrations_come_first_and_the_models_fill_them_up(gnm):
    jaw = JawOpening.of(gnm)
    opened, closed = (jaw.displacement(jaw.coefficients(gap)) for gap in (0.03, 0.005))
    two = replace(SETTINGS, poses=PoseSettings(mouths=2))
    record = tongue_basis(gnm, two, sources=TongueSources(expressions=[closed, opened], fill=True)).record
    assert (record["mouths_registered"], record["mouths"]) == (1, 2)
    with pytest.raises(InputError, match="open mouth"):
        tongue_basis(gnm, SETTINGS, sources=TongueSources(expressions=[closed]))
