"""Splines of space: what costs nothing, what they interpolate, and what a length leaves out."""

import numpy as np

from registration.geometry.space_spline import SpaceSpline

POINTS = 0.1 * np.random.default_rng(0).standard_normal((120, 3))


def test_affine_fields_cost_nothing():
    spline = SpaceSpline.of(POINTS, 40)
    assert spline.values.shape == (120, 40)
    affine = POINTS @ [1.0, -2.0, 0.5] + 3
    found = np.linalg.lstsq(spline.values[:, :4], affine, rcond=None)[0]
    np.testing.assert_allclose(spline.values[:, :4] @ found, affine, atol=1e-12)
    assert not spline.energy[:4].any() and (spline.energy[4:] > 0).all()


def test_a_center_at_every_point_interpolates_anything():
    values = np.random.default_rng(1).standard_normal(len(POINTS))
    fields = SpaceSpline.of(POINTS, 1000).values
    assert fields.shape == (120, 120)
    np.testing.assert_allclose(fields @ np.linalg.solve(fields, values), values, atol=1e-6)


def test_a_length_leaves_out_shorter_waves():
    """On a plane, a wave of which `length` is 1 / 2 pi of the period is halved."""
    step = 0.004
    x, y = (axis.ravel() for axis in np.meshgrid(*2 * [np.arange(-0.1, 0.1, step)]))
    spline = SpaceSpline.of(np.stack([x, y, 0 * x], 1), 600)
    kept = []
    for period in (0.04, 0.06, 0.10):
        wave = np.sin(2 * np.pi * x / period)
        matrix = step**2 * spline.values.T @ spline.values + np.diag((0.06 / 2 / np.pi) ** 5 * spline.energy + 1e-15)
        smooth = spline.values @ np.linalg.solve(matrix, step**2 * spline.values.T @ wave)
        inner = np.maximum(np.abs(x), np.abs(y)) < 0.06
        kept.append((smooth[inner] @ wave[inner]) / (wave[inner] @ wave[inner]))
    assert kept[0] < 0.25 < 0.4 < kept[1] < 0.6 < 0.85 < kept[2]
