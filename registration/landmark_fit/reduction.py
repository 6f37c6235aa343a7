"""Expression coefficients reduced to what the landmarks of a scheme can determine."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from registration.landmark_fit.observations import Observations
from registration.landmark_fit.options import FitOptions
from registration.model.gnm_npz import GNMData
from registration.model.landmarks import LandmarkScheme

_LEAST_INFORMATION = 0.1  # of a direction relative to its prior: less recovers less than a tenth of what is true
_STEP = 4.0  # information is rounded up to a power of it: fits of similar images share a basis


@dataclass(frozen=True, kw_only=True, eq=False)
class Reduction:
    """Raw coefficients = mean + basis @ reduced ones, which have a normal prior of unit variance."""

    mean: Float[np.ndarray, "E"]
    basis: Float[np.ndarray, "E Q"]
    root: Float[np.ndarray, "E E"]  # of the prior's covariance, root @ root^T


def information_per_metre(observations: Observations, pixels_per_metre: float) -> float:
    """Information of all observations of one landmark on a displacement, 1 / m^2, rounded up to a power of `_STEP`."""
    sigma = float(np.median(observations.sigma_px[observations.seen]))
    counts = observations.seen.sum((1, 2)) / max(1, observations.seen.any((0, 1)).sum())
    information = float(counts.max()) * (pixels_per_metre / sigma) ** 2
    return float(_STEP ** np.ceil(np.log(information) / np.log(_STEP)))


def reduce_expression(data: GNMData, scheme: LandmarkScheme, options: FitOptions, information: float) -> Reduction:
    """Return the directions of the expression coefficients that the landmarks move visibly.

    In an eigenbasis of the landmarks' information the prior stays the identity; directions without information stay at
    the prior's mean, where the full problem would leave them.

    Args:
        data: the model.
        scheme: whose landmarks may be seen.
        options: the prior.
        information: per square metre of displacement (`information_per_metre`).
    """
    count = len(data.expression_basis)
    prior = options.expression_prior
    mean = np.zeros(count) if prior is None else prior.mean.astype(np.float64)
    if prior is None:
        root = np.eye(count) * options.expression_sigma
    else:
        values, vectors = np.linalg.eigh(prior.covariance.astype(np.float64))
        root = vectors * np.sqrt(np.maximum(values, 0))
    vertices = data.expression_basis[:, scheme.indices].astype(np.float64)
    moved = np.einsum("elkd,lk->lde", vertices, scheme.weights, optimize=True).reshape(-1, count) @ root
    values, vectors = np.linalg.eigh(information * (moved.T @ moved))
    kept = values > _LEAST_INFORMATION
    return Reduction(mean=mean, basis=root @ vectors[:, kept][:, ::-1], root=root)
