import numpy as np

from registration.geometry.extrapolation import extrapolate


def _strip(length: int = 200, width: int = 5, h: float = 1e-3) -> tuple[np.ndarray, np.ndarray]:
    x, y = np.meshgrid(np.arange(length), np.arange(width), indexing="ij")
    corner = (x * width + y)[:-1, :-1].ravel()
    triangles = [np.stack([corner, corner + width, corner + width + 1], 1)]
    triangles += [np.stack([corner, corner + width + 1, corner + 1], 1)]
    return np.stack([x.ravel() * h, y.ravel() * h, 0.0 * x.ravel()], 1), np.concatenate(triangles)


def test_known_values_stay_and_what_follows_fades_over_the_reach():
    points, triangles = _strip()
    known = points[:, 0] < 0.05 - 1e-9
    values = np.where(known, 2.0, 77.0)[:, None]
    found = extrapolate(values, known, triangles, points, reach_m=0.02)
    assert (found[known] == 2).all()
    border = points[known, 0].max()
    for away in (0.01, 0.02, 0.04):
        row = np.abs(points[:, 0] - border - away) < 1e-6
        np.testing.assert_allclose(found[row], 2 * np.exp(-away / 0.02), rtol=0.2)
    assert (np.diff(found[::5, 0]) <= 1e-12).all()


def test_where_nothing_is_known_there_is_zero():
    points, triangles = _strip()
    both = np.concatenate([points, points + [0, 1, 0]])
    faces = np.concatenate([triangles, triangles + len(points)])
    known = np.arange(len(both)) < 10
    found = extrapolate(np.ones((len(both), 3)), known, faces, both, reach_m=0.02)
    assert np.abs(found[len(points) :]).max() == 0 and found[:10].min() == 1
    assert not extrapolate(np.ones((len(points), 1)), np.zeros(len(points), bool), triangles, points, reach_m=1.0).any()
