"""The initial guess refined in all views: a landmark fit that begins at the closed form's pose."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from registration.errors import InputError
from registration.fit.variables import InitialGuess, pivot
from registration.landmark_fit.fit import fit_landmarks
from registration.landmark_fit.observations import MIN_POINTS, Observations, of_capture
from registration.landmark_fit.options import FitOptions
from registration.landmark_fit.result import LandmarkFit
from registration.model.gnm_npz import GNMData
from registration.model.landmarks import LandmarkScheme
from registration.types import Capture, HeadPose

_PIXELS = 2.0  # standard deviation of landmarks whose spread nobody states, px at 512 px of image height
_MODEL_SPREAD_M = 0.3e-3  # of a scheme without a spread: the model does not span the subject
_MEASURED_SPREAD_M = 1e-3  # the same beside the spread of a detector's map
_HEAD_ROTATION = 0.05  # radians; landmarks of the face say little about the neck
_REFERENCE_PX = 512


def seen_landmarks(capture: Capture, schemes: Mapping[str, LandmarkScheme]) -> Observations | None:
    """Return the landmarks of all schemes that model and capture share, as one scheme; None: there are too few.

    Args:
        capture: with cameras in the world of the fit.
        schemes: of the model.
    """
    parts = []
    sigma = _PIXELS * float(np.median([view.camera.height_px for view in capture.views])) / _REFERENCE_PX
    for name in sorted({name for view in capture.views for name in view.landmarks} & set(schemes)):
        scheme = schemes[name]
        count = len(scheme.indices)
        spread = (
            np.full(count, _MODEL_SPREAD_M)
            if scheme.spread_m is None
            else np.hypot(scheme.spread_m, _MEASURED_SPREAD_M)
        )
        parts.append(of_capture(capture, replace(scheme, spread_m=spread), sigma))
    if not parts or sum(int(part.seen.sum()) for part in parts) < MIN_POINTS:
        return None
    return _joined(parts)


def refined(
    data: GNMData, landmarks: Observations, guess: InitialGuess | None, *, neutral: InitialGuess | None, size: bool
) -> InitialGuess | None:
    """Fit identity, expression and pose to the landmarks of all views.

    Args:
        data: the model.
        landmarks: of the capture.
        guess: where to begin; None: at poses from linear equations.
        neutral: of the same subject: its identity, offsets and scale are kept.
        size: estimate the size of the head.

    Returns:
        The guess with the fit's values; None: the fit failed.
    """
    options = FitOptions(
        identity=None if neutral is None else neutral.identity,
        offsets=None if neutral is None else neutral.offsets,
        scale=1.0 if guess is None else guess.scale,
        size=size and neutral is None,
        head_rotation=_HEAD_ROTATION,
        covariance=False,
        anatomy=0.0,
    )
    poses = None if guess is None else [_head_pose(guess, data)]
    try:
        fit = fit_landmarks(landmarks, data, options, poses)
    except InputError:
        return None
    if fit.status == "failed":
        return None
    return _as_guess(fit, data, guess, neutral)


def _head_pose(guess: InitialGuess, data: GNMData) -> HeadPose:
    translation = guess.position - guess.scale * guess.rotation @ pivot(data)
    return HeadPose(rotation=guess.rotation, translation=translation, scale=guess.scale)


def _as_guess(
    fit: LandmarkFit, data: GNMData, guess: InitialGuess | None, neutral: InitialGuess | None
) -> InitialGuess:
    rotation = Rotation.from_rotvec(fit.rotations[0, 0]).as_matrix()
    root = data.template_joint_positions[0] + np.tensordot(fit.identity, data.joint_identity_basis[:, 0], 1)
    position = fit.scale * (rotation @ (pivot(data) - root) + root) + fit.translation[0]
    return InitialGuess(
        rotation=rotation,
        position=position,
        scale=fit.scale,
        identity=fit.identity,
        expression=fit.expression[0],
        joints=fit.rotations[0, 1:],
        offsets=None if neutral is None else neutral.offsets,
        landmarks_used={} if guess is None else guess.landmarks_used,
        notes=() if guess is None else guess.notes,
    )


def _joined(parts: Sequence[Observations]) -> Observations:
    schemes = [part.scheme for part in parts]
    spreads = [scheme.spread_m for scheme in schemes if scheme.spread_m is not None]
    together = LandmarkScheme(
        name=" + ".join(scheme.name for scheme in schemes),
        indices=np.concatenate([scheme.indices for scheme in schemes]),
        weights=np.concatenate([scheme.weights for scheme in schemes]),
        spread_m=np.concatenate(spreads),
    )
    return Observations(
        scheme=together,
        views=parts[0].views,
        points_px=np.concatenate([part.points_px for part in parts], 2),
        sigma_px=np.concatenate([part.sigma_px for part in parts], 2),
    )
