import numpy as np
import pytest

from registration.errors import InputError
from registration.landmark_fit.prior import prior_file, read_expression_prior
from tests.registration.landmark_fit.scenes import tiny


def _write(path, names, mean, covariance):
    np.savez(path, names=np.array(names), mean=mean, covariance=covariance)


def test_named_components_have_their_statistics(tmp_path):
    data = tiny()
    model = tmp_path / "head.npz"
    assert read_expression_prior(model, data, 0.5) is None
    names = [str(name) for name in data.expression_names[:2]][::-1]
    _write(prior_file(model), names, np.array([1.0, 2.0]), np.array([[4.0, 1.0], [1.0, 9.0]]))
    prior = read_expression_prior(model, data, 0.5)
    np.testing.assert_array_equal(prior.mean[:2], [2.0, 1.0])
    assert not prior.mean[2:].any()
    np.testing.assert_allclose(prior.covariance[:2, :2], np.array([[9, 1], [1, 4]]) + 0.0125 * np.eye(2))
    np.testing.assert_allclose(np.diag(prior.covariance)[2:], 0.25)


@pytest.mark.parametrize(
    "names, covariance", [(["nobody"], np.eye(1)), (None, np.eye(2)), (None, np.full((1, 1), np.nan))]
)
def test_other_statistics_are_refused(tmp_path, names, covariance):
    data = tiny()
    model = tmp_path / "head.npz"
    _write(prior_file(model), names or [str(data.expression_names[0])], np.zeros(1), covariance)
    with pytest.raises(InputError, match="statistics of expressions"):
        read_expression_prior(model, data, 0.5)


def test_a_damaged_file_is_refused(tmp_path):
    model = tmp_path / "head.npz"
    prior_file(model).write_bytes(b"PK\x03\x04 nothing")
    with pytest.raises(InputError, match="statistics of expressions"):
        read_expression_prior(model, tiny(), 0.5)
