import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from registration.geometry.geodesic import edge_distances
from registration.geometry.topology import edges
from registration.landmark_fit.anatomy import Anatomy, contacts
from registration.landmark_fit.fit import fit_landmarks
from registration.landmark_fit.landmark_model import turned
from registration.landmark_fit.observations import Observations
from registration.landmark_fit.options import FitOptions
from registration.landmark_fit.reduction import Reduction
from registration.landmark_fit.state import Layout, free_columns
from registration.model import gnm_npz, landmarks
from registration.model.gnm import GNM
from registration.model.gnm_npz import GNMData
from registration.types import Parameters
from tests.conftest import SHARED, needs_shared

SIGMA = 0.5  # of expression coefficients


@pytest.fixture(scope="module")
def full() -> GNMData:
    return gnm_npz.read(SHARED / "data" / "gnm" / "gnm_head_reconstructed.npz")


@pytest.fixture(scope="module")
def anatomy(full) -> Anatomy:
    count = len(full.expression_basis)
    root = SIGMA * np.eye(count)
    return Anatomy(full, Reduction(mean=np.zeros(count), basis=root, root=root))


def crossed(data: GNMData, seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A head whose parts lie in one another: identity, expression in standard deviations, rotations."""
    rng = np.random.default_rng(seed)
    rotations = rng.normal(0, 0.2, (4, 3))
    rotations[0] = 0
    return rng.normal(size=len(data.vertex_identity_basis)), rng.normal(size=len(data.expression_basis)), rotations


@needs_shared
def test_the_template_costs_nothing(full, anatomy):
    still = np.tile(np.eye(3), (4, 1, 1))
    assert anatomy.energy(np.zeros(len(full.vertex_identity_basis)), np.zeros(len(full.expression_basis)), still) == 0


@needs_shared
def test_lips_do_not_touch_at_the_corners_of_the_mouth(full):
    rest = 1e3 * full.template_vertex_positions.astype(np.float64)
    along = edges(full.triangles.astype(np.int64)).vertices
    for contact in contacts(full)[-2:]:  # either lip against the other
        surface = np.isin(np.arange(len(rest)), contact.triangles)
        corners = np.flatnonzero(edge_distances(rest, along, surface, 2.0) < 2.0)
        assert len(contact.points) > 50
        assert not np.isin(contact.points, corners).any()


@needs_shared
def test_all_parts_are_where_the_model_has_them(full, anatomy):
    identity, expression, rotations = crossed(full, 4)
    parameters = Parameters(
        identity=torch.tensor(identity),
        expression=torch.tensor(SIGMA * expression),
        rotations=torch.tensor(rotations),
        translation=torch.zeros(3, dtype=torch.float64),
        scale=torch.tensor(1.0, dtype=torch.float64),
    )
    expected = 1e3 * GNM(full, dtype=torch.float64)(parameters).numpy()[anatomy.index]
    joints = Rotation.from_rotvec(rotations).as_matrix()
    np.testing.assert_allclose(anatomy.vertices_mm(identity, expression, joints), expected, atol=0.05)


@needs_shared
def test_rows_are_the_derivatives_of_the_energy(full, anatomy):
    identity, expression, rotations = crossed(full, 3)
    joints = Rotation.from_rotvec(rotations).as_matrix()
    layout = Layout(identity=len(identity), groups=1, views=1, expression=len(expression), joints=4)
    free = free_columns(layout, np.ones(layout.local_count, bool), np.ones(layout.shared_count, bool))
    ((jacobian, residual),) = anatomy.rows(identity, expression, joints, layout, free)
    assert anatomy.energy(identity, expression, joints) == pytest.approx(0.5 * (residual**2).sum())
    gradient = jacobian.T @ residual
    rng = np.random.default_rng(0)
    for _ in range(4):
        local, shared = rng.normal(size=layout.local_count), rng.normal(size=layout.shared_count)
        along = gradient @ np.concatenate([local, shared])

        def energy(step: float, local: np.ndarray = local, shared: np.ndarray = shared) -> float:
            moved = joints.copy()
            moved[1:] = turned(joints[1:], step * local[layout.local("joints")].reshape(-1, 3))
            return anatomy.energy(
                identity + step * shared[layout.shared("identity")],
                expression + step * local[layout.local("expression")],
                moved,
            )

        assert (energy(1e-6) - energy(-1e-6)) / 2e-6 == pytest.approx(along, rel=1e-4)


@needs_shared
def test_a_fit_with_the_term_keeps_parts_apart(full, anatomy):
    identity, expression, rotations = crossed(full, 5)
    model = GNM(full, dtype=torch.float64)
    parameters = Parameters(
        identity=torch.tensor(identity),
        expression=torch.tensor(0.6 * SIGMA * expression),
        rotations=torch.tensor(rotations),
        translation=torch.zeros(3, dtype=torch.float64),
        scale=torch.tensor(1.0, dtype=torch.float64),
    )
    scheme = landmarks.shipped_schemes(full)["face478"]
    points = scheme.points(model(parameters).numpy())
    camera = (points - points.mean(0)) * [1, -1, -1] + [0, 0, 0.55]
    pixels = 640 * camera[:, :2] / camera[:, 2:] + 256 + np.random.default_rng(0).normal(0, 1, (len(points), 2))
    observations = Observations.of_image(scheme, pixels, (512, 512), focal_px=640.0)
    excess = {}
    for weight in (0.0, 1.0):
        fit = fit_landmarks(observations, full, FitOptions(anatomy=weight, covariance=False))
        joints = Rotation.from_rotvec(fit.rotations[0]).as_matrix()
        excess[weight] = anatomy.excess_mm(fit.identity, fit.expression[0] / SIGMA, joints).max(initial=0)
        assert fit.status == "converged"
    assert excess[0.0] > 0.5
    assert excess[1.0] < 0.3
