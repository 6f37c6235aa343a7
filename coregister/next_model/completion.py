"""Missing-data completion: skin that no camera observed is estimated from the observed skin and the previous model.

See docs/algorithms.md, "Missing-data completion".
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float, Int

from registration.geometry.extrapolation import extrapolate
from registration.geometry.topology import vertex_areas
from registration.model import regions
from registration.model.gnm_npz import GNMData

_STEP = 4  # every fourth vertex of a dense skin enters the estimate


@dataclass(frozen=True, kw_only=True)
class CompletionSettings:
    """What counts as observed, and how the rest is estimated.

    Attributes:
        min_confidence: a vertex with at least this confidence is kept as it is.
        detail_mm: standard deviation of the difference between a face and its best approximation by the model, and
        detail_size_mm: the length over which that difference is correlated; nearer points are no new evidence.
        fade_mm: distance over which that difference fades into unobserved skin.
        cranium: what the unobserved cranium of a neutral is like. model: as the auxiliary model beside the previous
            model expects it (`registration.cranium`), if there is one. off: as all other unobserved skin.
    """

    min_confidence: float = 0.1
    detail_mm: float = 1.0
    detail_size_mm: float = 15.0
    fade_mm: float = 15.0
    cranium: Literal["model", "off"] = "model"


class MissingDataCompletion:
    """Completes displacements from a template with one basis of the previous model: identity or expression.

    Coefficients have a standard normal prior (`basis` is scaled by standard deviations). Their posterior mean given the
    observed skin, b = (B'WB + I)^-1 B'W d with W = observed fraction x area / detail_size^2 / detail^2, displaces
    the unobserved skin; the residual of the observed skin is extrapolated beyond its border
    (`geometry.extrapolation`). Teeth, tongue and eyes stay: a model's coefficients have placed them as a whole.
    """

    def __init__(self, data: GNMData, basis: Float[np.ndarray, "K V 3"], settings: CompletionSettings):
        """Prepare the weights.

        Args:
            data: the previous model, whose template is at rest.
            basis: one of its bases, metres.
            settings: of the estimate.
        """
        self._settings = settings
        self._triangles, self._points = data.triangles, data.template_vertex_positions.astype(np.float64)
        self._exterior, self._skin = regions.exterior(data), regions.skin(data)
        area = vertex_areas(self._points, data.triangles)
        unit = settings.detail_size_mm * settings.detail_mm * 1e-6
        self._rows = _subset(np.flatnonzero(self._exterior))
        # The rows of the subset represent the area of all.
        self._weight = area[self._rows] * area[self._exterior].sum() / area[self._rows].sum() / unit**2
        self._basis = basis
        self._basis_rows = basis[:, self._rows].astype(np.float64)

    def has_missing(self, confidence: Float[np.ndarray, "V"]) -> bool:
        """Return whether any exterior skin has less than the minimum confidence."""
        return bool((confidence[self._exterior] < self._settings.min_confidence).any())

    def __call__(
        self, displacement: Float[np.ndarray, "V 3"], confidence: Float[np.ndarray, "V"]
    ) -> Float[np.ndarray, "V 3"]:
        """Return the completed displacement, metres, the template's frame.

        Unchanged where all exterior skin is observed. Otherwise the inner surfaces of eye sockets and mouth count as
        missing too, where their confidence is low.
        """
        if not self.has_missing(confidence):
            return displacement
        observed = np.where(self._skin, np.clip(confidence / self._settings.min_confidence, 0, 1), 1)
        estimate = self._estimate(displacement, observed)
        residual = displacement - estimate
        fade_m = self._settings.fade_mm / 1000
        extrapolated = extrapolate(residual, observed >= 1, self._triangles, self._points, reach_m=fade_m)
        blend = observed[:, None]
        return estimate + blend * residual + (1 - blend) * extrapolated

    def _estimate(
        self, displacement: Float[np.ndarray, "V 3"], observed: Float[np.ndarray, "V"]
    ) -> Float[np.ndarray, "V 3"]:
        weight = (self._weight * observed[self._rows])[None, :, None]
        flat = self._basis_rows.reshape(len(self._basis_rows), -1)
        weighted = (self._basis_rows * weight).reshape(len(flat), -1)
        right = weighted @ displacement[self._rows].ravel()
        coefficients = np.linalg.solve(weighted @ flat.T + np.eye(len(flat)), right)
        return np.tensordot(coefficients, self._basis, 1)


def _subset(rows: Int[np.ndarray, "R"]) -> Int[np.ndarray, "_"]:
    return rows[:: _STEP if len(rows) > 2000 else 1]
