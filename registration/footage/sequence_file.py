"""The file of a fitted sequence, `fit.npz`: identity, parameters of every frame, cameras, residuals, uncertainties."""

from pathlib import Path

import numpy as np

from registration.storage.npz import NpzSchema

FILE = "fit.npz"
SCHEMA = NpzSchema(
    title="file of a fitted sequence",
    fix="give the fit.npz that `gnmreg fit` wrote, or fit again",
    fields={
        "identity": ("float", "I"),
        "expression": ("float", "F E"),
        "rotations": ("float", "F J 3"),
        "translation": ("float", "F 3"),
        "scale": ("float", ""),
        "frames": ("integer", "F"),
        "times_s": ("float", "F"),
        "camera_intrinsics": ("float", "N 3 3"),
        "camera_T_cam_world": ("float", "N 4 4"),
        "camera_size_px": ("integer", "N 2"),
        "camera_k1": ("float", "N"),
        "focal_sigma_px": ("float", "N"),
        "residual_px": ("float", "F N L 2"),
        "weights": ("float", "F N L"),
        "identity_covariance": ("float", "I I"),
        "expression_sigma": ("float", "F E"),
        "status": ("text", ""),
        "reason": ("text", ""),
        "scheme": ("text", ""),
        "config": ("text", ""),
    },
    finite=False,  # residuals are NaN where a landmark is not seen
)


def read_sequence(file: Path) -> dict[str, np.ndarray]:
    """Read the arrays of a fitted sequence.

    Raises:
        InputError: the file is missing, damaged, or of another kind.
    """
    return SCHEMA.read(file)
