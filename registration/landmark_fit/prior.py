"""The prior of expression coefficients that a built model carries: NAME.expressions.npz beside NAME.npz."""

from pathlib import Path
from zipfile import BadZipFile

import numpy as np

from registration.errors import InputError
from registration.landmark_fit.options import ExpressionPrior
from registration.model.gnm_npz import GNMData

_SHARE = 0.05  # of the plain prior's variance, added: the samples are fewer than the components


def prior_file(model: Path) -> Path:
    """Where the statistics of a model's expression coefficients lie, if it has any."""
    return Path(model).with_name(f"{Path(model).stem}.expressions.npz")


def read_expression_prior(model: Path, data: GNMData, sigma: float) -> ExpressionPrior | None:
    """Read the mean and covariance of a model's expression coefficients.

    Args:
        model: the model's file.
        data: its content.
        sigma: standard deviation of components without statistics.

    Returns:
        The prior of all components; None: the model carries none.

    Raises:
        InputError: the file is damaged, or of another model.
    """
    path = prior_file(model)
    if not path.exists():
        return None
    try:
        with np.load(path, allow_pickle=False) as arrays:
            names, mean, covariance = (arrays[name] for name in ("names", "mean", "covariance"))
        places = {name: k for k, name in enumerate(map(str, data.expression_names))}
        rows = np.array([places[str(name)] for name in names])
        if covariance.shape != (len(rows), len(rows)) or mean.shape != (len(rows),):
            raise ValueError(f"a covariance of {covariance.shape} for {len(rows)} names")
        if not (np.isfinite(mean).all() and np.isfinite(covariance).all()):
            raise ValueError("numbers that are not finite")
    except (OSError, KeyError, ValueError, BadZipFile) as error:
        raise InputError(
            "The statistics of expressions beside the model cannot be used",
            where=path,
            expected="names of the model's expression components, their mean and covariance",
            got=error,
            fix="build the model again, or move the file away to fit with independent coefficients",
        ) from None
    count = len(data.expression_basis)
    whole, of_all = np.zeros(count), np.eye(count) * sigma**2
    whole[rows] = mean
    of_all[np.ix_(rows, rows)] = (covariance + covariance.T) / 2 + _SHARE * sigma**2 * np.eye(len(rows))
    return ExpressionPrior(mean=whole, covariance=of_all)
