import numpy as np

from registration.geometry.smoothstep import smoothstep


def test_the_step_rises_or_falls_between_its_thresholds_and_is_flat_at_them():
    x = np.array([-1.0, 1, 1.25, 1.5, 2, 3])
    np.testing.assert_allclose(smoothstep(1, 2, x), [0, 0, 0.15625, 0.5, 1, 1])
    np.testing.assert_allclose(smoothstep(2, 1, x), [1, 1, 0.84375, 0.5, 0, 0])
    slope = np.diff(smoothstep(0, 1, np.array([0, 1e-6, 1 - 1e-6, 1]))) / 1e-6
    assert abs(slope[0]) < 1e-5 and abs(slope[2]) < 1e-5
