import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from registration.landmark_fit.contact import Contact, ContactDepths

RADIUS_MM = 10.0


def sphere(centre: tuple[float, float, float]) -> tuple[np.ndarray, np.ndarray]:
    """A closed sphere of 24 x 48 quads in triangles, normals outwards."""
    rows, columns = 24, 48
    polar = np.linspace(0, np.pi, rows + 1)[1:-1]
    around = np.linspace(0, 2 * np.pi, columns, endpoint=False)
    ring = np.stack([np.cos(around), np.sin(around)], 1)
    points = [[0, 0, 1], *[[np.sin(p) * x, np.sin(p) * y, np.cos(p)] for p in polar for x, y in ring], [0, 0, -1]]
    last = len(points) - 1
    triangles = []
    for c in range(columns):
        d = (c + 1) % columns
        triangles += [[0, 1 + c, 1 + d], [last, last - columns + d, last - columns + c]]
        for r in range(rows - 2):
            a, b = 1 + r * columns + c, 1 + r * columns + d
            triangles += [[a, a + columns, b], [b, a + columns, b + columns]]
    return RADIUS_MM * np.array(points) + np.array(centre), np.array(triangles)


def scene(**kind: bool) -> tuple[ContactDepths, np.ndarray, int]:
    """Two spheres side by side and points around them."""
    (a, first), (b, second) = sphere((0, 0, 0)), sphere((20.5, 0, 0))
    points = np.random.default_rng(0).uniform([-9, -9, -9], [30, 9, 9], (400, 3))
    rest = np.concatenate([a, b, points])
    triangles = np.concatenate([first, second + len(a)])
    index = np.arange(len(a) + len(b), len(rest))
    contact = Contact(points=index, triangles=triangles, **kind)
    return ContactDepths([contact], rest), rest, len(a) + len(b)


@pytest.mark.parametrize("kind", [{}, {"solid": True}, {"rigid": True}])
def test_depth_is_that_in_the_sphere_in_which_a_point_lies(kind):
    depths, rest, first = scene(**kind)
    turn = Rotation.from_rotvec([0.3, -1.1, 0.7]).as_matrix()
    found = depths(1.05 * rest @ turn.T + [3.0, -40.0, 8.0], np.full(400, 0.2))
    x = rest[first:]
    exact = 1.05 * np.maximum(*(RADIUS_MM - np.linalg.norm(x - centre, axis=1) for centre in ([0, 0, 0], [20.5, 0, 0])))
    # Facets lie below the sphere by less than 0.1 mm; the largest depths are beyond the reach.
    expected = np.flatnonzero((exact > 0.3) & (exact < 5.0))
    assert len(expected) > 60
    assert np.isin(expected, found.query).all()
    assert (exact[found.query] > 0.15).all()
    np.testing.assert_allclose(found.depth, exact[found.query], atol=0.12)


def test_depths_are_those_of_their_linearization():
    depths, rest, _ = scene(rigid=True)
    found = depths(rest, np.zeros(400))
    nearest = (found.weights[:, :, None] * rest[found.triangle]).sum(1)
    np.testing.assert_allclose((found.direction * (nearest - rest[found.point])).sum(1), found.depth, atol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(found.direction, axis=1), 1, atol=1e-12)
