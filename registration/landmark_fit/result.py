"""The result of a landmark fit."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from registration.landmark_fit.options import FitOptions
from registration.model.gnm import GNM
from registration.model.gnm_npz import GNMData
from registration.types import Camera, Parameters, Status


@dataclass(frozen=True, kw_only=True, eq=False)
class LandmarkFit:
    """The model fitted to one subject in F frames and N views; the world is the given cameras', else the first's."""

    status: Status
    reason: str
    identity: Float[np.ndarray, "I"]
    expression: Float[np.ndarray, "F E"]
    rotations: Float[np.ndarray, "F J 3"]  # axis-angle, each joint relative to its parent
    translation: Float[np.ndarray, "F 3"]  # metres
    scale: float
    cameras: tuple[Camera, ...]  # of the views, with estimated intrinsics, k1 as distortion, and poses
    residual_px: Float[np.ndarray, "F N L 2"]  # fitted minus observed; NaN: not seen
    weights: Float[np.ndarray, "F N L"]  # robust weights in [0, 1]; 0: not seen
    identity_covariance: Float[np.ndarray, "I I"]  # posterior
    expression_sigma: Float[np.ndarray, "F E"]  # posterior standard deviation of each coefficient
    focal_sigma_px: Float[np.ndarray, "N"]  # posterior standard deviation; 0: given
    shape_covariance: Float[np.ndarray, "S S"] | None  # posterior, of identity and first expression: S = I + E
    seconds: float
    iterations: int
    energy: float
    options: FitOptions

    def parameters(self, frame: int | slice = slice(None)) -> Parameters:
        """The model's parameters of one frame or some, float64 tensors."""
        chosen = self.expression[frame]
        identity = np.broadcast_to(self.identity, (*chosen.shape[:-1], len(self.identity)))
        values = {
            "identity": identity,
            "expression": chosen,
            "rotations": self.rotations[frame],
            "translation": self.translation[frame],
            "scale": np.full(chosen.shape[:-1], self.scale),
        }
        return Parameters(**{name: torch.as_tensor(value.copy()) for name, value in values.items()})

    def vertices(self, data: GNMData, frame: int | slice = 0) -> Float[np.ndarray, "*F V 3"]:
        """Vertices of one frame or some, world, metres."""
        model = GNM(data, dtype=torch.float64)
        offsets = None if self.options.offsets is None else torch.as_tensor(self.options.offsets, dtype=torch.float64)
        with torch.no_grad():
            return model(self.parameters(frame), offsets).numpy()

    def vertex_sigma_m(self, data: GNMData) -> Float[np.ndarray, "V 3"]:
        """Posterior standard deviation of the first frame's vertices, metres, along the axes of the first camera.

        That of the shape in the head's frame: the uncertainty of the head's position is not part of it.
        """
        if self.shape_covariance is None:
            raise ValueError("fitted with options.covariance off")
        basis = np.concatenate([data.vertex_identity_basis, data.expression_basis]).astype(np.float64)
        cov = self.shape_covariance
        axes = self.cameras[0].T_cam_world[:3, :3] @ Rotation.from_rotvec(self.rotations[0, 0]).as_matrix()
        sigma = np.empty((basis.shape[1], 3))
        for axis in range(3):
            along = basis @ axes[axis]
            sigma[:, axis] = self.scale * np.sqrt(np.maximum(((cov @ along) * along).sum(0), 0))
        return sigma

    @property
    def rms_px(self) -> Float[np.ndarray, "F"]:
        """Weighted root mean square distance of each frame's landmarks, px; NaN where nothing counts."""
        squared = np.nan_to_num((self.residual_px**2).sum(-1))
        total = self.weights.sum((1, 2))
        return np.sqrt((self.weights * squared).sum((1, 2)) / np.where(total > 0, total, np.nan))
