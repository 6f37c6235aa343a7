"""Options of a landmark fit: what is estimated, and how far it is expected from its mean."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float


@dataclass(frozen=True, kw_only=True, eq=False)
class ExpressionPrior:
    """Mean and covariance of expression coefficients, as a built model carries them."""

    mean: Float[np.ndarray, "E"]
    covariance: Float[np.ndarray, "E E"]


@dataclass(frozen=True, kw_only=True)
class TemporalPrior:
    """Standard deviations of what changes from one frame to the next, of a talking head at 30 frames a second."""

    expression: float = 0.3  # coefficients
    rotation: float = 0.01  # of root and joints, radians
    translation_m: float = 7e-4


@dataclass(frozen=True, kw_only=True, eq=False)
class FitOptions:
    """Options of `fit_landmarks`. Standard deviations are those of the prior, about zero unless said."""

    expression_sigma: float = 0.5  # of expression coefficients; that of identity coefficients is 1
    expression_prior: ExpressionPrior | None = None  # in place of `expression_sigma`
    head_rotation: float = 0.3  # of the head about the neck, radians
    eye_rotation: float = 0.35  # radians
    log_focal: float = 0.3  # of an unknown focal length about `focal_guess`
    focal_guess: float = 1.2  # relative to the longer side of the image
    principal_point: bool = False  # estimate it, about the image's centre, of views that state none
    principal_sigma: float = 0.02  # relative to the image's width
    distortion: bool = False  # estimate one radial coefficient of each group of views that state no principal point
    distortion_sigma: float = 0.1
    scale: float = 1.0  # the head's size relative to the model's
    size: bool = False  # estimate it, about `scale`
    log_size: float = 0.1
    temporal: TemporalPrior | None = None  # None: frames are independent but for the identity
    robust: bool = True  # Geman-McClure weights in the last stage
    robust_sigmas: float = 4.0  # distance at which a landmark's weight is a quarter
    correlated: float = 1.0  # so many neighbouring landmarks err alike and count as one
    anatomy: float = 1.0  # weight of penetrations of eyeballs and lids, teeth and lips, tongue and mouth; 0: none
    covariance: bool = True  # estimate posterior standard deviations
    max_iterations: int = 30  # of each stage
    tolerance: float = 1e-3  # decrease of the energy (minus the logarithm of the posterior) per frame that ends a fit
    identity: Float[np.ndarray, "I"] | None = None  # known: it is not estimated
    offsets: Float[np.ndarray, "V 3"] | None = None  # of the bind pose, metres, known
