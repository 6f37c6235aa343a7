"""How uncertain a fitted shape is: standard deviations of its vertices, in numbers, in words and as a picture."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from registration.frames import MM_PER_M
from registration.landmark_fit.result import LandmarkFit
from registration.model.gnm_npz import GNMData
from registration.model.regions import exterior


@dataclass(frozen=True, kw_only=True, eq=False)
class Uncertainty:
    """Posterior standard deviations of the first frame's shape in the head's frame."""

    vertex_sigma_mm: Float[np.ndarray, "V 3"]  # along the first camera's axes: right, down, depth
    nose: int  # the vertex of its tip
    face: Bool[np.ndarray, "V"]  # vertices of the skin in front of the head's centre

    @property
    def total_mm(self) -> Float[np.ndarray, "V"]:
        """Root of the sum of the squares along the three axes."""
        return np.asarray(np.linalg.norm(self.vertex_sigma_mm, axis=1))

    @property
    def nose_depth_mm(self) -> float:
        """Of the nose's tip, along the first camera's viewing direction."""
        return float(self.vertex_sigma_mm[self.nose, 2])

    @property
    def face_median_mm(self) -> float:
        """Median of `total_mm` over the face."""
        return float(np.median(self.total_mm[self.face]))

    def sentence(self, views: int) -> str:
        """Return the uncertainty in words, for a number of views."""
        of = "one view" if views == 1 else f"{views} views"
        return (
            f"depth of the nose \N{PLUS-MINUS SIGN}{self.nose_depth_mm:.1f} mm, "
            f"half of the face within \N{PLUS-MINUS SIGN}{self.face_median_mm:.1f} mm (one standard deviation, {of})"
        )


def uncertainty_of(fit: LandmarkFit, data: GNMData) -> Uncertainty:
    """Return the uncertainty of a fit that estimated its covariance."""
    template = data.template_vertex_positions.astype(np.float64)
    skin = exterior(data)
    nose = int(np.where(skin, template[:, 2], -np.inf).argmax())
    front = skin & (template[:, 2] > np.median(template[skin, 2]))
    return Uncertainty(vertex_sigma_mm=MM_PER_M * fit.vertex_sigma_m(data), nose=nose, face=front)
