"""The model fitted to landmarks: `fit_landmarks`, and `fit_many` for independent subjects."""

import time
from collections.abc import Iterable, Iterator, Sequence

import numpy as np

from registration.errors import InputError
from registration.landmark_fit.anatomy import Anatomy
from registration.landmark_fit.finish import finished
from registration.landmark_fit.landmark_model import LandmarkModel
from registration.landmark_fit.observations import MIN_POINTS, Observations
from registration.landmark_fit.options import FitOptions
from registration.landmark_fit.reduction import Reduction, information_per_metre, reduce_expression
from registration.landmark_fit.result import LandmarkFit
from registration.landmark_fit.stages import run_stages
from registration.landmark_fit.start import mean_head, start_poses
from registration.model.gnm_npz import GNMData
from registration.model.landmarks import LandmarkScheme
from registration.types import HeadPose

_KEPT = 3  # bases of different accuracy: the sizes of faces in a batch of images differ


def fit_landmarks(
    observations: Observations,
    data: GNMData,
    options: FitOptions | None = None,
    poses: Sequence[HeadPose] | None = None,
) -> LandmarkFit:
    """Fit identity, expressions, poses and unknown cameras to landmarks in images by Levenberg-Marquardt.

    Stages (Wood 2022): pose and focal length; identity; everything; everything with robust weights.

    Args:
        observations: of one subject, in one frame or several, one view or several.
        data: the model.
        options: what is estimated, and the priors.
        poses: of the head in each frame, where the fit begins, if the cameras' poses are known; None: estimated by
            linear equations.

    Returns:
        The fit; its status says whether it converged.

    Raises:
        InputError: fewer than `MIN_POINTS` landmarks are seen in a frame, landmarks are mirrored, or no view can be
            posed.
    """
    _check(observations)
    return _Prepared(observations.scheme, data, options or FitOptions()).fit(observations, poses)


def fit_many(batch: Iterable[Observations], data: GNMData, options: FitOptions | None = None) -> Iterator[LandmarkFit]:
    """Fit independent subjects, as `fit_landmarks`; what depends on model and scheme alone is prepared once.

    Args:
        batch: observations of one subject each.
        data: the model.
        options: of all fits.

    Yields:
        The fits, in order.

    Raises:
        InputError: as `fit_landmarks`.
    """
    prepared: _Prepared | None = None
    for observations in batch:
        _check(observations)
        if prepared is None or prepared.scheme is not observations.scheme:
            prepared = _Prepared(observations.scheme, data, options or FitOptions())
        yield prepared.fit(observations)


def _check(observations: Observations) -> None:
    counts = observations.seen.sum((1, 2))
    few = np.flatnonzero(counts < MIN_POINTS)
    if len(few):
        raise InputError(
            "Too few landmarks are seen",
            where=f"frame {few[0]}" + (f" and {len(few) - 1} more" if len(few) > 1 else ""),
            expected=f"at least {MIN_POINTS} landmarks",
            got=int(counts[few[0]]),
            fix="use images that show the face, or leave such frames out",
        )


class _Prepared:
    """What fits of one model to one scheme share."""

    def __init__(self, scheme: LandmarkScheme, data: GNMData, options: FitOptions):
        self.scheme, self._data, self._options = scheme, data, options
        self._mean = mean_head(scheme, data, options)
        self._restricted: dict[float, tuple[Reduction, LandmarkModel, Anatomy | None]] = {}  # by information

    def _model(
        self, observations: Observations, pixels_per_metre: float
    ) -> tuple[Reduction, LandmarkModel, Anatomy | None]:
        information = information_per_metre(observations, pixels_per_metre)
        if information not in self._restricted:
            reduction = reduce_expression(self._data, self.scheme, self._options, information)
            model = LandmarkModel(
                self._data,
                self.scheme.indices,
                self.scheme.weights,
                expression_map=reduction.basis,
                expression_mean=reduction.mean,
                offsets=self._options.offsets,
            )
            anatomy = None
            if self._options.anatomy > 0:
                anatomy = Anatomy(self._data, reduction, self._options.anatomy, self._options.offsets, model.anchor)
            if len(self._restricted) == _KEPT:
                self._restricted.pop(next(iter(self._restricted)))
            self._restricted[information] = (reduction, model, anatomy)
        return self._restricted[information]

    def fit(self, observations: Observations, poses: Sequence[HeadPose] | None = None) -> LandmarkFit:
        began = time.perf_counter()
        options = self._options
        start = start_poses(observations, self._mean, options)
        if poses is not None:
            start = start.at(poses)
        reduction, model, anatomy = self._model(observations, start.pixels_per_metre)
        identity = np.zeros(len(self._data.vertex_identity_basis)) if options.identity is None else options.identity
        state = start.state(identity.astype(np.float64), reduction.basis.shape[1], model.joint_count, options.scale)
        minimum, problem, free = run_stages(observations, options, start, state, model, reduction, anatomy)
        return finished(minimum, problem, free, observations, reduction, time.perf_counter() - began)
