"""A classifier of coefficients that knows nothing of the sampler: linear discriminant analysis."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

_SHRINKAGE = 1e-3  # of the pooled covariance towards a multiple of the identity


@dataclass(frozen=True, kw_only=True, eq=False)
class LinearClassifier:
    """Scores of K classes, linear in the coefficients."""

    weights: Float[np.ndarray, "K D"]
    bias: Float[np.ndarray, "K"]

    def predict(self, coefficients: Float[np.ndarray, "N D"]) -> Int[np.ndarray, "N"]:
        """Return the class of the highest score of each sample."""
        return np.asarray((coefficients @ self.weights.T + self.bias).argmax(1))


def fit_classifier(
    coefficients: Float[np.ndarray, "N D"], classes: Int[np.ndarray, "N"], count: int
) -> LinearClassifier:
    """Fit class means and the covariance within classes; all classes are equally likely [Fisher 1936].

    Args:
        coefficients: of the samples.
        classes: of the samples, from 0 to count - 1; a class without samples is never predicted.
        count: number of classes.
    """
    x = np.asarray(coefficients, np.float64)
    numbers = np.bincount(classes, minlength=count)
    means = np.stack([x[classes == k].mean(0) if numbers[k] else np.zeros(x.shape[1]) for k in range(count)])
    centred = x - means[classes]
    covariance = centred.T @ centred / len(x)
    covariance += _SHRINKAGE * np.trace(covariance) / len(covariance) * np.eye(len(covariance)) + 1e-12 * np.eye(
        len(covariance)
    )
    weights = np.linalg.solve(covariance, means.T).T
    bias = np.where(numbers > 0, -0.5 * (weights * means).sum(1), -np.inf)
    return LinearClassifier(weights=weights, bias=bias)
