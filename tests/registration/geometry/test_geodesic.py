import numpy as np

from registration.geometry.geodesic import edge_distances


def test_distances_follow_the_edges_and_end_at_the_limit() -> None:
    vertices = np.array([[0, 0, 0], [1, 0, 0], [1, 2, 0], [0, 2, 0], [5, 5, 5]], float)
    edges = np.array([[0, 1], [1, 2], [2, 3]])
    sources = np.arange(5) == 0
    assert edge_distances(vertices, edges, sources).tolist() == [0, 1, 3, 4, np.inf]
    assert edge_distances(vertices, edges, sources, limit=3).tolist() == [0, 1, 3, np.inf, np.inf]


def test_without_a_source_everything_is_out_of_reach() -> None:
    assert np.isinf(edge_distances(np.zeros((2, 3)), np.array([[0, 1]]), np.zeros(2, bool))).all()
