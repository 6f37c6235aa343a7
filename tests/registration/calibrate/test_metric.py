import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from registration.calibrate.metric import fit_model
from registration.model import gnm_npz
from registration.model.landmarks import LandmarkScheme
from tests.conftest import SHARED, needs_shared

pytestmark = needs_shared


@pytest.fixture(scope="module")
def model() -> tuple[gnm_npz.GNMData, LandmarkScheme]:
    data = gnm_npz.read(SHARED / "data/gnm/gnm_head_reconstructed.npz")
    front = np.flatnonzero(data.template_vertex_positions[:, 2] > 0.06)
    chosen = np.random.default_rng(0).choice(front, 100, replace=False)
    indices = np.repeat(chosen[:, None], 3, axis=1).astype(np.int64)
    scheme = LandmarkScheme(name="test", indices=indices, weights=np.tile([1.0, 0.0, 0.0], (100, 1)))
    return data, scheme


def person(data: gnm_npz.GNMData, seed: int) -> np.ndarray:
    generator = np.random.default_rng(seed)
    identity = generator.normal(size=len(data.vertex_identity_basis))
    return data.template_vertex_positions + np.tensordot(identity, data.vertex_identity_basis, 1)


@pytest.mark.parametrize("seed", range(3))
def test_scale_and_pose_are_found_to_their_standard_deviation(
    model: tuple[gnm_npz.GNMData, LandmarkScheme], seed: int
) -> None:
    data, scheme = model
    generator = np.random.default_rng(seed)
    truth = scheme.points(person(data, seed).astype(np.float64))
    turn, shift = Rotation.random(random_state=seed).as_matrix(), generator.normal(size=3)
    points = (truth + generator.normal(size=truth.shape) * 1e-3 - shift) @ turn / 0.37  # of a world in another unit
    points[:5] = np.nan
    points[5] += 0.3  # an outlier
    fit = fit_model(data, scheme, points)
    assert fit.scale_sigma < 0.05
    assert abs(fit.scale / 0.37 - 1) < 4 * fit.scale_sigma
    assert Rotation.from_matrix(fit.rotation @ turn.T).magnitude() < np.radians(6)
    assert np.isnan(fit.distance_m[:5]).all() and np.nanmedian(fit.distance_m) < 3e-3


def test_a_fixed_shape_is_the_mean_head(model: tuple[gnm_npz.GNMData, LandmarkScheme]) -> None:
    data, scheme = model
    mean = scheme.points(data.template_vertex_positions.astype(np.float64))
    fit = fit_model(data, scheme, 2.0 * mean + [0.1, 0, 0], fixed_shape=True)
    assert fit.scale == pytest.approx(0.5)
    np.testing.assert_allclose(fit.landmarks, mean)
    np.testing.assert_allclose(fit.distance_m, 0, atol=1e-9)
