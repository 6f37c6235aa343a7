"""Skin that no camera saw follows the previous model, given what was seen."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from registration.geometry.extrapolation import continued
from registration.geometry.topology import vertex_areas
from registration.model import regions
from registration.model.gnm_npz import GNMData


@dataclass(frozen=True, kw_only=True)
class Unseen:
    """How much is seen, and how the rest is guessed."""

    sure: float = 0.1  # confidence from which on a vertex is taken as it is
    detail_mm: float = 1.0  # what faces differ by from the best of the model, standard deviation, and
    detail_size_mm: float = 15.0  # over which length: points nearer than that say the same
    reach_mm: float = 15.0  # over which the last seen difference from the model fades out


class Completion:
    """Fills displacements from a template, of one kind: of identity or of expression.

    The model's coefficients have a standard normal prior (`basis` is scaled by standard deviations). Their mean given
    the seen skin, b = (B'WB + I)^-1 B'W d, with weights W = share seen x area / detail_size^2 / detail^2, displaces
    the skin that was not seen; what the seen skin differs by from that continues beyond its border
    (`geometry.fill.continued`). Teeth, tongue and eyes stay: they are a model's already, moved as a whole by whatever
    of them was seen.
    """

    def __init__(self, data: GNMData, basis: Float[np.ndarray, "K V 3"], settings: Unseen):
        self._settings = settings
        self._triangles, self._points = data.triangles, data.template_vertex_positions.astype(np.float64)
        self._exterior, self._skin = regions.exterior(data), regions.skin(data)
        area = vertex_areas(self._points, data.triangles)
        unit = settings.detail_size_mm * settings.detail_mm * 1e-6
        self._rows = _thinned(np.flatnonzero(self._exterior), 4)
        # The rows that are left stand for the others too.
        self._weight = area[self._rows] * area[self._exterior].sum() / area[self._rows].sum() / unit**2
        self._basis = basis
        self._thin = basis[:, self._rows].astype(np.float64)

    def unseen(self, confidence: Float[np.ndarray, "V"]) -> bool:
        """Whether there is anything to fill: exterior skin of which a camera is less than sure."""
        return bool((confidence[self._exterior] < self._settings.sure).any())

    def __call__(
        self, displacement: Float[np.ndarray, "V 3"], confidence: Float[np.ndarray, "V"]
    ) -> Float[np.ndarray, "V 3"]:
        """Metres, the template's frame. As it came where everything outside is sure; linings count as unseen then."""
        if not self.unseen(confidence):
            return displacement
        share = np.where(self._skin, np.clip(confidence / self._settings.sure, 0, 1), 1)
        guess = self._guess(displacement, share)
        difference = displacement - guess
        reach = self._settings.reach_mm / 1000
        filled = continued(difference, share >= 1, self._triangles, self._points, reach_m=reach)
        blend = share[:, None]
        return guess + blend * difference + (1 - blend) * filled

    def _guess(self, displacement: Float[np.ndarray, "V 3"], share: Float[np.ndarray, "V"]) -> Float[np.ndarray, "V 3"]:
        weight = (self._weight * share[self._rows])[None, :, None]
        flat = self._thin.reshape(len(self._thin), -1)
        weighted = (self._thin * weight).reshape(len(flat), -1)
        right = weighted @ displacement[self._rows].ravel()
        coefficients = np.linalg.solve(weighted @ flat.T + np.eye(len(flat)), right)
        return np.tensordot(coefficients, self._basis, 1)


def _thinned(rows: Int[np.ndarray, "R"], step: int) -> Int[np.ndarray, "_"]:
    return rows[:: step if len(rows) > 2000 else 1]
