"""Whether landmarks lie on the side of the head that the camera sees."""

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float

from registration.errors import InputError
from registration.geometry.topology import vertex_normals
from registration.landmark_fit.initial_pose import Orthographic
from registration.landmark_fit.observations import Observations
from registration.model.gnm_npz import GNMData
from registration.model.landmarks import LandmarkScheme

_MIN_SHARE = 0.3  # of the seen landmarks, on surfaces that face the camera
_FRAMES = 20  # that are tested


def landmark_normals(scheme: LandmarkScheme, data: GNMData) -> Float[np.ndarray, "L 3"]:
    """Normals of the mean head at a scheme's landmarks, model frame."""
    template = torch.as_tensor(data.template_vertex_positions, dtype=torch.float64)
    return scheme.points(vertex_normals(template, torch.as_tensor(data.triangles.astype(np.int64))).numpy())


def check_facing(
    observations: Observations, normals: Float[np.ndarray, "L 3"], poses: Sequence[Sequence[Orthographic | None]]
) -> None:
    """Raise InputError if landmarks are mostly on surfaces that face away from the cameras that see them.

    Under orthographic projection mirrored landmarks are those of a head seen from behind: the pose fits as well, but
    surfaces would have to be transparent.

    Args:
        observations: of one subject.
        normals: of the landmarks (`landmark_normals`).
        poses: of the frames and views.
    """
    shares = []
    for frame, seen in list(zip(poses, observations.seen, strict=True))[:_FRAMES]:
        for pose, visible in zip(frame, seen, strict=True):
            if pose is not None:
                shares.append(float((normals[visible] @ pose.rotation[2] < 0).mean()))
    if shares and np.median(shares) < _MIN_SHARE:
        raise InputError(
            "The landmarks are mirrored",
            where=f"landmarks of scheme {observations.scheme.name}",
            expected="the subject's right side on the left of an image that faces it",
            got=f"{1 - np.median(shares):.0%} of the landmarks on surfaces that face away from the camera",
            fix="mirror the images back, or exchange the landmarks of left and right",
        )
